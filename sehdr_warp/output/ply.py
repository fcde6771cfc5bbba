"""A trained scene as PLY: scene-linear for HDR tools, or baked to display colors for the viewers of 3DGS.

The files have the attributes of 3D Gaussian Splatting (Kerbl et al. 2023, the reference release), little-endian
float32: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..3(K-1)-1 (all coefficients of red, then of green, then of blue),
opacity (logit), scale_0..2 (logarithm), rot_0..3 (w x y z).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sehdr_warp.errors import InputError, SehdrError

from ..files import atomic_path, check_absent
from .exr import NOT_FINITE

KINDS = ("hdr", "ldr")

_HARMONIC_0 = 0.5 / np.sqrt(np.pi)
# Radiance below this is written as this: its logarithm must be finite.
_DARKEST = 1e-12
# For a fit: more than three directions for each of the 16 coefficients of degree 3, and the sphere's whole weight
# against 1 for all the cameras together; more cameras than these only cost time.
_SPHERE_DIRECTIONS, _SPHERE_WEIGHT, _MAX_CAMERAS = 64, 0.05, 48
_CHUNK = 4096

Colors = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class GaussianArrays:
    """N Gaussians as NumPy arrays, float32.

    means [N, 3] world; log_scales [N, 3], natural logarithm of the standard deviations; quaternions [N, 4] (w x y z);
    opacity_logits [N]; harmonics [N, (degree + 1)^2, 3], degree 0 to 3. color_model: what their sum over a viewing
    direction means, per channel: "display": sRGB-encoded color max(sum + 0.5, 0), as every 3DGS viewer takes it; "log":
    scene-linear radiance exp(sum); "linear": max(sum, 0). base_time: seconds at which the scene was photographed.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray
    color_model: str
    base_time: float

    @property
    def degree(self) -> int:
        return math.isqrt(self.harmonics.shape[1]) - 1

    def with_colors(self, harmonics: np.ndarray, color_model: str) -> "GaussianArrays":
        return replace(self, harmonics=np.ascontiguousarray(harmonics, np.float32), color_model=color_model)


def export(
    run: Any, path: Path | str, *, kind: str = "hdr", exposure_time: float | None = None, overwrite: bool = False
) -> Path:
    """Writes the Gaussians of a trained run as PLY; returns the path.

    kind: "hdr" for scene-linear radiance, "ldr" for display colors at exposure_time: seconds, by default the scene's.

    Raises SehdrError for another kind or an exposure time that is not positive, InputError where the file exists
    (unless overwrite) or a value is not finite.
    """
    if kind not in KINDS:
        raise SehdrError(f"PLY kind {kind!r} is not one of {', '.join(KINDS)}")
    if exposure_time is not None and kind == "hdr":
        raise SehdrError("an HDR PLY has no exposure time; leave it out, or write kind ldr")
    check_absent(path, overwrite)  # Before minutes of fitting.
    gaussians = hdr_gaussians(run) if kind == "hdr" else ldr_gaussians(run, exposure_time)
    write_gaussians(path, gaussians, overwrite=overwrite)
    return Path(path)


def hdr_gaussians(run) -> GaussianArrays:
    """Scene-linear: exact where harmonics are exposures or their logarithms; else, with fused brackets or harmonics of
    encoded values, fitted to the logarithm of the radiance (see bake)."""
    stored, to_radiance = _stored(run)
    if to_radiance is not None:
        return bake(stored, lambda c: np.log(np.maximum(to_radiance(c), _DARKEST)), "log", _seen_from(run))
    harmonics = stored.harmonics.astype(np.float64)
    if stored.color_model == "linear":
        return stored.with_colors(harmonics / run.base_time, "linear")
    harmonics[:, 0] -= np.log(run.base_time) / _HARMONIC_0
    return stored.with_colors(harmonics, "log")


def ldr_gaussians(run, exposure_time: float | None = None) -> GaussianArrays:
    """What the run's response makes of each Gaussian's radiance. Viewers blend these colors, not radiance: half-covered
    edges of very bright things come out darker than in a photo."""
    time = run.base_time if exposure_time is None else float(exposure_time)
    if not (np.isfinite(time) and time > 0):
        raise SehdrError(f"exposure time {time:g} is not positive and finite; give seconds")
    stored, to_radiance = _stored(run)
    if stored.color_model == "display" and time == run.base_time:
        return stored
    radiance = to_radiance or (lambda exposure: exposure / run.base_time)
    return bake(stored, lambda colors: run.response.encode(radiance(colors) * time), "display", _seen_from(run))


def _stored(run) -> tuple[GaussianArrays, Colors | None]:
    """The run's Gaussians in its model's colors, and how these become radiance; None where they are exposures."""
    tensors = {name: value.cpu().numpy() for name, value in run.model.gaussians.tensors().items()}
    harmonics = np.concatenate([tensors.pop("harmonics_dc"), tensors.pop("harmonics_rest")], axis=1)
    color_model = run.model.color_model.name
    gaussians = GaussianArrays(**tensors, harmonics=harmonics, color_model=color_model, base_time=run.base_time)
    if run.model.color_model.encoded:
        return gaussians, lambda encoded: run.response.decode(np.clip(encoded, 0, 1)) / run.base_time
    return gaussians, None if run.model.fusion is None else lambda exposure: _fuse(run, exposure)


def _fuse(run, exposure: np.ndarray) -> np.ndarray:
    """[N, D, 3] radiance of [N, D, 3] exposures at the base time."""
    import torch

    logs = torch.from_numpy(np.log(np.maximum(exposure, _DARKEST)).reshape(-1, 3).astype(np.float32))
    with torch.no_grad():
        fused = run.model.fusion(logs.to(run.model.gaussians.means.device))
    return fused.cpu().numpy().reshape(exposure.shape).astype(np.float64)


def _seen_from(run) -> np.ndarray:
    return np.array([entry.camera.position for entry in run.cameras if entry.split == "train"]).reshape(-1, 3)


def harmonic_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """[..., (degree + 1)^2] float64 real spherical harmonics of unit directions [..., 3], orthonormal over the sphere,
    with the Condon-Shortley phase and in the order of 3D Gaussian Splatting: l = 0, 1, ..., and m = -l ... l."""
    from scipy.special import sph_harm_y

    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    basis = []
    for order in range(degree + 1):
        for m in range(-order, order + 1):
            value = sph_harm_y(order, abs(m), polar, azimuth)
            basis.append(value.real if m == 0 else np.sqrt(2) * (value.real if m > 0 else value.imag))
    return np.stack(basis, axis=-1)


def sphere_directions(count: int = _SPHERE_DIRECTIONS) -> np.ndarray:
    """[count, 3] unit vectors, evenly over the sphere (a Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth, ring = np.pi * (1 + np.sqrt(5)) * index, np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def evaluate_colors(gaussians: GaussianArrays, directions: np.ndarray) -> np.ndarray:
    """[N, D, 3] colors in the model's own meaning for directions [D, 3] or [N, D, 3]."""
    value = harmonic_basis(directions, gaussians.degree) @ gaussians.harmonics.astype(np.float64)
    if gaussians.color_model == "log":
        return np.exp(np.clip(value, -80, 80))
    return np.maximum(value + (0.5 if gaussians.color_model == "display" else 0.0), 0)


def bake(gaussians: GaussianArrays, change: Colors, color_model: str, camera_positions: np.ndarray) -> GaussianArrays:
    """The same Gaussians with harmonics of the same degree fitted to changed colors by least squares: a camera response
    and the fusion of brackets act on the radiance of a direction, not on harmonics.

    Directions in which a Gaussian was photographed count most, since elsewhere its harmonics were never held to
    anything; an even cover of the sphere keeps the fit bounded there.

    change: [N, D, 3] colors of the present model -> [N, D, 3] of color_model. camera_positions: [C, 3] from where the
    scene was photographed; with none, all directions weigh alike.
    """
    count = min(len(camera_positions), _MAX_CAMERAS)
    cameras = camera_positions[np.linspace(0, len(camera_positions) - 1, count).round().astype(int)]
    sphere = sphere_directions()
    weights = np.repeat([_SPHERE_WEIGHT / len(sphere), 1 / max(count, 1)], [len(sphere), count])
    offset = 0.5 if color_model == "display" else 0.0
    fitted = np.empty_like(gaussians.harmonics)
    for start in range(0, len(gaussians.means), _CHUNK):
        rows = slice(start, start + _CHUNK)
        part = replace(gaussians, means=gaussians.means[rows], harmonics=gaussians.harmonics[rows])
        seen = part.means[:, None].astype(np.float64) - cameras
        seen /= np.maximum(np.linalg.norm(seen, axis=2, keepdims=True), 1e-12)
        directions = np.concatenate([np.broadcast_to(sphere, (len(seen), *sphere.shape)), seen], axis=1)
        wanted = change(evaluate_colors(part, directions)) - offset
        basis = harmonic_basis(directions, gaussians.degree)
        weighted = (basis * weights[:, None]).swapaxes(1, 2)
        fitted[rows] = np.linalg.solve(weighted @ basis, weighted @ wanted)
    return gaussians.with_colors(fitted, color_model)


def write_gaussians(path: Path | str, gaussians: GaussianArrays, *, overwrite: bool = False) -> None:
    """The color model and the base exposure time are `comment sehdr:...` lines of the header.

    Raises InputError where a value is NaN or infinite (with field and index) or the file exists (unless overwrite),
    SehdrError where it cannot be written.
    """
    from plyfile import PlyData, PlyElement

    count = len(gaussians.means)
    rest = gaussians.harmonics[:, 1:].swapaxes(1, 2).reshape(count, -1)
    parts = {
        "x y z": gaussians.means,
        "nx ny nz": np.zeros((count, 3)),
        "f_dc_0 f_dc_1 f_dc_2": gaussians.harmonics[:, 0],
        " ".join(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        "opacity": gaussians.opacity_logits[:, None],
        "scale_0 scale_1 scale_2": gaussians.log_scales,
        "rot_0 rot_1 rot_2 rot_3": gaussians.quaternions,
    }
    columns = [pair for names, values in parts.items() for pair in zip(names.split(), values.T, strict=True)]
    table = np.empty(count, [(name, "<f4") for name, _ in columns])
    for name, values in columns:
        bad = ~np.isfinite(values)
        if bad.any():
            index = int(np.argmax(bad))
            fault = f"{name} of {int(bad.sum())} Gaussians is not finite, the first {values[index]} at {index}"
            raise InputError(path, fault, NOT_FINITE)
        table[name] = values
    facts = {"color_model": gaussians.color_model, "base_exposure_time": repr(gaussians.base_time)}
    comments = [f"sehdr:{name} {value}" for name, value in facts.items()]
    with atomic_path(path, overwrite) as temporary, temporary.open("wb") as file:
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=comments).write(file)
