"""Colours of Gaussians in another model: spherical harmonics fitted to what a scene shows in each direction.

A camera response does not act on harmonics, and neither does the fusion of brackets: both act on the radiance of a
direction. So the radiance is evaluated over many directions, changed there, and harmonics of the same degree are
fitted to it by least squares. Directions in which a Gaussian was photographed count most, since elsewhere its
harmonics were never held to anything; an even cover of the sphere keeps the fit bounded there.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .gaussian_file import GaussianArrays

# More than three directions for each of the 16 coefficients of degree 3.
SPHERE_DIRECTIONS = 64
# The sphere's whole weight against 1 for all the cameras together.
SPHERE_WEIGHT = 0.05
# Enough to know what was seen; more cameras only cost time.
MAX_CAMERAS = 48
_CHUNK = 4096


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
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def evaluate_colors(gaussians: GaussianArrays, directions: np.ndarray) -> np.ndarray:
    """[N, D, 3] colours in the model's own meaning (see COLOR_MODELS) for directions [D, 3] or [N, D, 3]."""
    basis = harmonic_basis(directions, gaussians.degree)
    if basis.ndim == 2:
        basis = np.broadcast_to(basis, (len(gaussians.means), *basis.shape))
    value = basis @ gaussians.harmonics.astype(np.float64)
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
    """The same Gaussians with harmonics fitted to changed colours.

    change: [N, D, 3] colours of the present model -> [N, D, 3] values that the new harmonics (with "display" after
        its offset of 0.5) shall give; called for some thousand Gaussians at a time.
    camera_positions: [C, 3] from where the scene was photographed; None weighs all directions alike.
    """
    sphere = sphere_directions()
    cameras = _thinned(camera_positions)
    weights = np.full(len(sphere), 1.0 / len(sphere))
    if len(cameras):
        weights = np.concatenate([weights * SPHERE_WEIGHT, np.full(len(cameras), 1.0 / len(cameras))])
    offset = 0.5 if color_model == "display" else 0.0
    fitted = np.empty(gaussians.harmonics.shape, np.float32)
    for start in range(0, len(gaussians.means), _CHUNK):
        rows = slice(start, start + _CHUNK)
        part = _rows(gaussians, rows)
        directions = np.broadcast_to(sphere, (len(part.means), *sphere.shape))
        if len(cameras):
            seen = part.means[:, None].astype(np.float64) - cameras
            seen /= np.maximum(np.linalg.norm(seen, axis=2, keepdims=True), 1e-12)
            directions = np.concatenate([directions, seen], axis=1)
        wanted = change(evaluate_colors(part, directions)) - offset
        fitted[rows] = fit_harmonics(directions, wanted, weights, gaussians.degree)
    return gaussians.with_colors(fitted, color_model)


def fit_harmonics(directions: np.ndarray, values: np.ndarray, weights: np.ndarray, degree: int) -> np.ndarray:
    """[N, K, 3] coefficients whose sums come nearest to values [N, D, 3] at directions [N, D, 3], weighted by [D]."""
    basis = harmonic_basis(directions, degree)
    weighted = basis * weights[:, None]
    return np.linalg.solve(weighted.swapaxes(1, 2) @ basis, weighted.swapaxes(1, 2) @ values)


def _thinned(positions: np.ndarray | None) -> np.ndarray:
    if positions is None or not len(positions):
        return np.empty((0, 3))
    chosen = np.linspace(0, len(positions) - 1, min(len(positions), MAX_CAMERAS)).round().astype(int)
    return np.asarray(positions, np.float64)[chosen]


def _rows(gaussians: GaussianArrays, rows: slice) -> GaussianArrays:
    names = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics")
    return replace(gaussians, **{name: getattr(gaussians, name)[rows] for name in names})
