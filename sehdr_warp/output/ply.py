"""A trained scene as PLY: scene-linear for HDR tools, or baked to display colors for the viewers of 3DGS."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sehdr_warp.errors import SehdrError

from ..files import check_absent
from .gaussians import GaussianArrays, bake, write_gaussians

log = logging.getLogger(__name__)
KINDS = ("hdr", "ldr")

_HARMONIC_0 = 0.5 / np.sqrt(np.pi)
# A degree of the harmonics that changes no color by more than this part is not stored: a half float rounds by more.
_UNSEEN = 1e-4
# Radiance below this is written as this: its logarithm must be finite.
_DARKEST = 1e-12

Colors = Callable[[np.ndarray], np.ndarray]


def export(
    run: Any,
    path: Path | str,
    *,
    kind: str = "hdr",
    exposure_time: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Writes the Gaussians of a trained run as PLY; returns the path.

    kind: "hdr": scene-linear radiance, see hdr_gaussians; "ldr": display colors, see ldr_gaussians.
    exposure_time: of "ldr", seconds; by default the one the scene was photographed at.

    Raises SehdrError for another kind or an exposure time that is not positive, InputError where the file exists
    (unless overwrite) or a value is not finite.
    """
    if kind not in KINDS:
        raise SehdrError(f"PLY kind {kind!r} is not one of {', '.join(KINDS)}")
    if exposure_time is not None and kind == "hdr":
        raise SehdrError("an HDR PLY has no exposure time; leave it out, or write kind ldr")
    check_absent(path, overwrite)  # Before minutes of fitting.
    gaussians = hdr_gaussians(run) if kind == "hdr" else ldr_gaussians(run, exposure_time)
    stored = without_unseen_degrees(gaussians)
    if stored.degree < gaussians.degree:
        log.info("harmonics above degree %d change no color visibly and are left out", stored.degree)
    write_gaussians(path, stored, overwrite=overwrite)
    return Path(path)


def without_unseen_degrees(gaussians: GaussianArrays) -> GaussianArrays:
    """The Gaussians without the highest degrees that change no color by more than a ten-thousandth ("display": of
    white) in any direction.

    A degree l with coefficients c changes a color by at most |c| sqrt((2 l + 1) / (4 pi)) (addition theorem).
    """
    harmonics, degree = gaussians.harmonics.astype(np.float64), gaussians.degree
    scale = np.abs(_HARMONIC_0 * harmonics[:, 0]) if gaussians.color_model == "linear" else 1.0
    while degree > 0:
        band = harmonics[:, degree**2 : (degree + 1) ** 2]
        largest = np.sqrt((band**2).sum(1) * (2 * degree + 1) / (4 * np.pi))
        if not (largest <= _UNSEEN * scale).all():  # NaN counts as seen, and is refused by name when it is written.
            break
        degree -= 1
    return gaussians.with_colors(gaussians.harmonics[:, : (degree + 1) ** 2], gaussians.color_model)


def hdr_gaussians(run) -> GaussianArrays:
    """The scene-linear Gaussians of a run: exact where harmonics are exposures or their logarithms; else, with fused
    brackets or harmonics of encoded values, fitted to the logarithm of the radiance (see bake)."""
    stored, to_radiance = _stored(run)
    if to_radiance is not None:
        return bake(
            stored, lambda c: np.log(np.maximum(to_radiance(c), _DARKEST)), "log", camera_positions=_seen_from(run)
        )
    harmonics = stored.harmonics.astype(np.float64)
    if stored.color_model == "linear":
        return stored.with_colors(harmonics / run.base_time, "linear")
    harmonics[:, 0] -= np.log(run.base_time) / _HARMONIC_0
    return stored.with_colors(harmonics, "log")


def ldr_gaussians(run, exposure_time: float | None = None) -> GaussianArrays:
    """Display colors of a run at an exposure time in seconds: what its response makes of each Gaussian's radiance.

    Viewers blend these, not radiance: half-covered edges of very bright things come out darker than in a photo.
    """
    time = run.base_time if exposure_time is None else float(exposure_time)
    if not (np.isfinite(time) and time > 0):
        raise SehdrError(f"exposure time {time:g} is not positive and finite; give seconds")
    stored, to_radiance = _stored(run)
    if stored.color_model == "display" and time == run.base_time:
        return stored
    radiance = to_radiance or (lambda exposure: exposure / run.base_time)

    def shown(colors):
        return run.response.encode(radiance(colors) * time)

    return bake(stored, shown, "display", camera_positions=_seen_from(run))


def _stored(run) -> tuple[GaussianArrays, Colors | None]:
    """The run's Gaussians in its model's colors, and how these become radiance; None where they are exposures."""
    tensors = {name: value.cpu().numpy() for name, value in run.model.gaussians.tensors().items()}
    harmonics = np.concatenate([tensors["harmonics_dc"], tensors["harmonics_rest"]], axis=1)
    geometry = (tensors[name] for name in ("means", "log_scales", "quaternions", "opacity_logits"))
    gaussians = GaussianArrays(*geometry, harmonics, run.model.color_model.name, run.base_time)
    if run.model.color_model.encoded:
        return gaussians, lambda encoded: run.response.decode(np.clip(encoded, 0, 1)) / run.base_time
    return gaussians, None if run.model.fusion is None else lambda exposure: _fuse(run, exposure)


def _fuse(run, exposure: np.ndarray) -> np.ndarray:
    """[N, D, 3] radiance of the fused brackets from [N, D, 3] exposures at the base time."""
    import torch

    logs = torch.from_numpy(np.log(np.maximum(exposure, _DARKEST)).reshape(-1, 3).astype(np.float32))
    with torch.no_grad():
        fused = run.model.fusion(logs.to(run.model.gaussians.means.device))
    return fused.cpu().numpy().reshape(exposure.shape).astype(np.float64)


def _seen_from(run) -> np.ndarray:
    return np.array([entry.camera.position for entry in run.cameras if entry.split == "train"])
