"""Gaussians as arrays: colors by direction, harmonics fitted to other colors, and PLY files for splat viewers.

The files have the attributes of 3D Gaussian Splatting (Kerbl et al. 2023, the reference release), little-endian
float32: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..3(K-1)-1 (all coefficients of red, then of green, then of blue),
opacity (logit), scale_0..2 (logarithm), rot_0..3 (w x y z).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sehdr_warp.errors import InputError

from ..files import atomic_path

COLOR_MODELS = ("display", "log", "linear")
"""What the sum of harmonics over a viewing direction d means, per channel:

display: sRGB-encoded color max(sum + 0.5, 0), as every 3DGS viewer takes it.
log: scene-linear radiance exp(sum). linear: scene-linear radiance max(sum, 0).
"""

# For a fit: more than three directions for each of the 16 coefficients of degree 3.
SPHERE_DIRECTIONS = 64
# The sphere's whole weight against 1 for all the cameras together.
SPHERE_WEIGHT = 0.05
# Enough to know what was seen; more cameras only cost time.
MAX_CAMERAS = 48
_CHUNK = 4096


@dataclass(frozen=True)
class GaussianArrays:
    """N Gaussians as NumPy arrays, float32.

    means [N, 3] world; log_scales [N, 3], natural logarithm of the standard deviations; quaternions [N, 4] (w x y z);
    opacity_logits [N]; harmonics [N, K, 3] with K = (degree + 1)^2, degree 0 to 3.
    color_model: one of COLOR_MODELS. base_time: seconds at which the scene was photographed.
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
        """The same Gaussians in other colors."""
        return replace(self, harmonics=np.ascontiguousarray(harmonics, np.float32), color_model=color_model)


def harmonic_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """[..., (degree + 1)^2] float64 real spherical harmonics of unit directions [..., 3], orthonormal over the sphere.

    With the Condon-Shortley phase and in the order of 3D Gaussian Splatting: l = 0, 1, ..., and m = -l ... l.
    """
    from scipy.special import sph_harm_y

    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    basis = []
    for order in range(degree + 1):
        for m in range(-order, order + 1):
            value = sph_harm_y(order, abs(m), polar, azimuth)
            basis.append(value.real if m == 0 else np.sqrt(2) * (value.real if m > 0 else value.imag))
    return np.stack(basis, axis=-1)


def sphere_directions(count: int = SPHERE_DIRECTIONS) -> np.ndarray:
    """[count, 3] unit vectors, evenly over the sphere (a Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth, ring = np.pi * (1 + np.sqrt(5)) * index, np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def evaluate_colors(gaussians: GaussianArrays, directions: np.ndarray) -> np.ndarray:
    """[N, D, 3] colors in the model's own meaning (see COLOR_MODELS) for directions [D, 3] or [N, D, 3]."""
    value = harmonic_basis(directions, gaussians.degree) @ gaussians.harmonics.astype(np.float64)
    if gaussians.color_model == "log":
        return np.exp(np.clip(value, -80, 80))
    return np.maximum(value + (0.5 if gaussians.color_model == "display" else 0.0), 0)


def bake(
    gaussians: GaussianArrays,
    change: Callable[[np.ndarray], np.ndarray],
    color_model: str,
    *,
    camera_positions: np.ndarray | None = None,
) -> GaussianArrays:
    """The same Gaussians with harmonics fitted to changed colors.

    A camera response and the fusion of brackets act on the radiance of a direction, not on harmonics. So radiance is
    evaluated over many directions, changed there, and harmonics of the same degree are fitted to it by least squares.
    Directions in which a Gaussian was photographed count most, since elsewhere its harmonics were never held to
    anything; an even cover of the sphere keeps the fit bounded there.

    change: [N, D, 3] colors of the present model -> [N, D, 3] values that the new harmonics (with "display" after
        its offset of 0.5) shall give; called for some thousand Gaussians at a time.
    camera_positions: [C, 3] from where the scene was photographed; None weighs all directions alike.
    """
    sphere, cameras = sphere_directions(), np.empty((0, 3))
    weights = np.full(len(sphere), 1.0 / len(sphere))
    if camera_positions is not None and len(camera_positions):
        count = min(len(camera_positions), MAX_CAMERAS)
        chosen = np.linspace(0, len(camera_positions) - 1, count).round().astype(int)
        cameras = np.asarray(camera_positions, np.float64)[chosen]
        weights = np.concatenate([weights * SPHERE_WEIGHT, np.full(count, 1.0 / count)])
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
    """Writes a PLY file; the color model and the base exposure time are `comment sehdr:...` lines of its header.

    Raises InputError where a value is NaN or infinite (with field and index) or the file exists (unless overwrite),
    SehdrError where it cannot be written.
    """
    from plyfile import PlyData, PlyElement

    rest = gaussians.harmonics[:, 1:].swapaxes(1, 2).reshape(len(gaussians.means), -1)
    columns = {
        **dict(zip("xyz", gaussians.means.T, strict=True)),
        **dict.fromkeys(("nx", "ny", "nz"), np.zeros(len(gaussians.means))),
        **{f"f_dc_{i}": gaussians.harmonics[:, 0, i] for i in range(3)},
        **{f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])},
        "opacity": gaussians.opacity_logits,
        **{f"scale_{i}": gaussians.log_scales[:, i] for i in range(3)},
        **{f"rot_{i}": gaussians.quaternions[:, i] for i in range(4)},
    }
    table = np.empty(len(gaussians.means), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        bad = ~np.isfinite(values)
        if bad.any():
            index = int(np.argmax(bad))
            raise InputError(
                path,
                f"{name} of {int(bad.sum())} Gaussians is not finite, the first {values[index]} at {index}",
                "such scenes are not written; train again from an earlier checkpoint or with another seed",
            )
        table[name] = values
    time = f"sehdr:base_exposure_time {gaussians.base_time!r}"
    comments = [f"sehdr:color_model {gaussians.color_model}", time]
    with atomic_path(path, overwrite) as temporary, temporary.open("wb") as file:
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=comments).write(file)
