"""Conversion between trained scenes and Gaussians whose harmonics mean what a file format can state.

A response and the fusion of brackets act on the light of a direction, and viewers blend encoded colors instead of
light, so no harmonics represent the scene exactly. They are fitted for each Gaussian separately (bake), then jointly to
pictures of the scene (fit_to_pictures).
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..progress import stage, track_progress
from ..response import response_by_name
from ..scene import Camera
from ..scene.normalization import Normalization
from ..splats.arrays import HARMONIC_0, GaussianArrays, colors_of_basis, harmonic_basis, rounded_means
from .adam import Adam
from .color_models import rec709_of
from .gaussians import Gaussians
from .pixel_filter import FocalRange, photo_filters
from .radiance_field import RadianceField

log = logging.getLogger(__name__)
# Smallest radiance whose logarithm is taken.
DARKEST = 1e-12
STEPS = 150
RATES = {"harmonics_dc": 0.03, "harmonics_rest": 0.01, "opacity_logits": 0.3}
# For a fit: more than three directions for each of the 16 coefficients of degree 3, and the sphere's whole weight
# against 1 for all the cameras together; more cameras than these only cost time.
_SPHERE_DIRECTIONS, _SPHERE_WEIGHT, _MAX_CAMERAS = 64, 0.05, 48
_CHUNK = 1024

Colors = Callable[[np.ndarray], np.ndarray]


def field_of(gaussians: GaussianArrays) -> RadianceField:
    """Return the field that Gaussians represent; its response is sRGB.

    Positions in float64, which float32 would move, are taken relative to their mean.
    """
    center = gaussians.means.mean(0) if gaussians.means.dtype == np.float64 else np.zeros(3)
    harmonics = gaussians.harmonics.astype(np.float64)
    if gaussians.color_model == "log":
        harmonics[:, 0] += np.log(gaussians.base_time) / HARMONIC_0
    elif gaussians.color_model == "linear":
        harmonics *= gaussians.base_time
    harmonics = torch.from_numpy(harmonics.astype(np.float32))
    means, log_scales, quaternions, logits = (
        torch.from_numpy(np.array(values, np.float32))
        for values in (gaussians.means - center, gaussians.log_scales, gaussians.quaternions, gaussians.opacity_logits)
    )
    model = Gaussians(means, log_scales, quaternions, logits, harmonics[:, :1], harmonics[:, 1:])
    options = {"base_time": gaussians.base_time, "color_model": gaussians.color_model}
    options |= {"normalization": Normalization(center), "antialiased": gaussians.antialiased}
    options |= {"photo_focals": gaussians.photo_focals and FocalRange(*gaussians.photo_focals)}
    field = RadianceField(model, response_by_name("srgb"), **options).requires_grad_(False)
    field.photo_filters, field.along_rays = gaussians.filters, gaussians.along_rays
    return field


def gaussians_of(
    field: RadianceField,
    color_model: str,
    camera_positions: np.ndarray,
    exposure_time: float | None = None,
    color_matrix: np.ndarray | None = None,
) -> GaussianArrays:
    """Return a field's Gaussians in the colors of a file.

    Exact if the field's own harmonics have that meaning; else fitted for each Gaussian (see bake). The result is in the
    coordinates of the scene, like camera_positions.

    Args:
        field: A trained field.
        color_model: "log" or "linear" for scene-linear radiance, "display" for values encoded by the field's response,
            or by sRGB if colors are converted to Rec.709.
        camera_positions: [C, 3] positions that the scene was photographed from.
        exposure_time: Seconds for "display", by default the base time.
        color_matrix: [3, 3] from the field's colors to linear Rec.709, if they are not Rec.709.
    """
    camera_positions = field.normalization.points(camera_positions)
    arrays = _in_colors(field, color_model, camera_positions, exposure_time, color_matrix)
    return to_scene(arrays, field.normalization)


def with_photo_filters(gaussians: GaussianArrays, cameras: Sequence[Camera]) -> GaussianArrays:
    """Return Gaussians with the filters of their training cameras, unless they have some or were compensated."""
    if gaussians.filters is not None or gaussians.photo_focals is None or not cameras:
        return gaussians
    means = torch.from_numpy(gaussians.means.astype(np.float64))
    return replace(gaussians, filters=photo_filters(means, cameras).mean.numpy())


def to_normalized(gaussians: GaussianArrays, normalization: Normalization) -> GaussianArrays:
    """Return Gaussians of scene coordinates in normalized ones."""
    return _transform(gaussians, normalization.points(gaussians.means), -math.log(normalization.unit))


def to_scene(gaussians: GaussianArrays, normalization: Normalization) -> GaussianArrays:
    """Return Gaussians of normalized coordinates in those of the scene."""
    if normalization.is_identity:
        return gaussians
    return _transform(gaussians, normalization.scene_points(gaussians.means), math.log(normalization.unit))


def _transform(gaussians: GaussianArrays, means: np.ndarray, log_scale: float) -> GaussianArrays:
    """Return Gaussians at other means [N, 3] float64, with sizes multiplied by exp(log_scale)."""
    sizes = (gaussians.log_scales.astype(np.float64) + log_scale).astype(np.float32)
    filters = None if gaussians.filters is None else gaussians.filters * np.float32(math.exp(log_scale))
    return replace(gaussians, means=rounded_means(means, sizes), log_scales=sizes, filters=filters)


def _in_colors(
    field: RadianceField,
    color_model: str,
    camera_positions: np.ndarray,
    exposure_time: float | None,
    color_matrix: np.ndarray | None,
) -> GaussianArrays:
    """Return gaussians_of() in the field's own coordinates, like camera_positions."""
    arrays, to_radiance = _arrays_of(field)
    is_exact = to_radiance is None and color_matrix is None  # But for the unit

    def radiance(colors: np.ndarray) -> np.ndarray:
        own = to_radiance(colors) if to_radiance else colors / field.base_time
        return own if color_matrix is None else rec709_of(torch.from_numpy(own), color_matrix, field.white).numpy()

    time = exposure_time or field.base_time
    if color_model == "display":
        if arrays.color_model == "display" and time == field.base_time and color_matrix is None:
            return arrays
        response = field.response if color_matrix is None else response_by_name("srgb")
        encoded = bake(arrays, lambda colors: response.encode(radiance(colors) * time), "display", camera_positions)
        return replace(encoded, base_time=time)  # The exposure that readers need to recover radiance.
    if is_exact and color_model == arrays.color_model:
        harmonics = arrays.harmonics.astype(np.float64)
        if color_model == "linear":
            return arrays.with_colors(harmonics / field.base_time, "linear")
        harmonics[:, 0] -= np.log(field.base_time) / HARMONIC_0
        return arrays.with_colors(harmonics, "log")
    if color_model == "linear":
        return bake(arrays, radiance, "linear", camera_positions)
    return bake(arrays, lambda colors: np.log(np.maximum(radiance(colors), DARKEST)), "log", camera_positions)


def _arrays_of(field: RadianceField) -> tuple[GaussianArrays, Colors | None]:
    """Return the Gaussians in the field's own colors, and their conversion to radiance (None if they are exposures)."""
    tensors: dict[str, Any] = {name: value.cpu().numpy() for name, value in field.gaussians.tensors().items()}
    harmonics = np.concatenate([tensors.pop("harmonics_dc"), tensors.pop("harmonics_rest")], axis=1)
    name = field.color_model.name
    facts = {"color_model": name, "base_time": field.base_time, "antialiased": field.antialiased}
    facts |= {"photo_focals": None if field.antialiased else field.photo_focals, "filters": field.photo_filters}
    facts |= {"along_rays": field.along_rays}
    gaussians = GaussianArrays(**tensors, harmonics=harmonics, **facts)
    if field.color_model.display_referred:
        return gaussians, lambda encoded: field.response.decode(np.clip(encoded, 0, 1)) / field.base_time
    return gaussians, None if field.fusion is None else lambda exposure: _fuse(field, exposure)


@torch.no_grad()
def _fuse(field: RadianceField, exposure: np.ndarray) -> np.ndarray:
    """Return fused radiance [N, D, 3] of exposures [N, D, 3] at the base time."""
    assert field.fusion is not None
    logs = torch.from_numpy(np.log(np.maximum(exposure, DARKEST)).reshape(-1, 3).astype(np.float32))
    fused = field.fusion(logs.to(field.render_device))
    return fused.cpu().numpy().reshape(exposure.shape).astype(np.float64)


def sphere_directions(count: int = _SPHERE_DIRECTIONS) -> np.ndarray:
    """Return [count, 3] unit vectors, evenly spread over the sphere (a Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth, ring = np.pi * (1 + np.sqrt(5)) * index, np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def bake(gaussians: GaussianArrays, change: Colors, color_model: str, camera_positions: np.ndarray) -> GaussianArrays:
    """Fit harmonics of the same degree to changed colors of each Gaussian, by least squares.

    Directions in which a Gaussian was photographed count most, because its harmonics were not constrained elsewhere; an
    even cover of the sphere keeps the fit bounded there.

    Args:
        gaussians: Gaussians in their present color model.
        change: Function from colors [N, D, 3] of the present model to colors [N, D, 3] of color_model.
        color_model: Color model of the result.
        camera_positions: [C, 3] positions that the scene was photographed from; with none, all directions weigh alike.
    """
    count = min(len(camera_positions), _MAX_CAMERAS)
    cameras = camera_positions[np.linspace(0, len(camera_positions) - 1, count).round().astype(int)]
    sphere = sphere_directions()
    weights = np.repeat([_SPHERE_WEIGHT / len(sphere), 1 / max(count, 1)], [len(sphere), count])
    offset = 0.5 if color_model == "display" else 0.0
    fitted = np.empty_like(gaussians.harmonics)
    with stage("fitting colors of Gaussians", len(gaussians.means), log) as progress:
        for start in range(0, len(gaussians.means), _CHUNK):
            rows = slice(start, start + _CHUNK)
            part = replace(gaussians, means=gaussians.means[rows], harmonics=gaussians.harmonics[rows])
            rays = part.means[:, None].astype(np.float64) - cameras
            rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
            directions = np.concatenate([np.broadcast_to(sphere, (len(rays), *sphere.shape)), rays], axis=1)
            basis = harmonic_basis(directions, gaussians.degree)
            target = change(colors_of_basis(part, basis)) - offset
            weighted = (basis * weights[:, None]).swapaxes(1, 2)
            fitted[rows] = np.linalg.solve(weighted @ basis, weighted @ target)
            progress.update(rows.stop)
    return gaussians.with_colors(fitted, color_model)


def fit_to_pictures(
    gaussians: GaussianArrays, picture: Callable[[Camera], Tensor], cameras: Sequence[Camera], *, steps: int = STEPS
) -> GaussianArrays:
    """Fit harmonics and opacities of display-color Gaussians to images by Adam; shapes stay.

    Args:
        gaussians: Gaussians of display colors.
        picture: Function from a camera to the encoded image [H, W, 3] in [0, 1] to fit.
        cameras: Cameras, visited equally often in an order of a fixed seed.
        steps: Number of Adam steps.
    """
    random = np.random.default_rng(0)
    order = [int(i) for _ in range(-(-steps // max(len(cameras), 1))) for i in random.permutation(len(cameras))][:steps]
    if not order:
        return gaussians
    targets = {index: picture(cameras[index]) for index in sorted(set(order))}
    device = next(iter(targets.values())).device
    field = field_of(gaussians).to(device)
    fitted = {name: getattr(field.gaussians, name).requires_grad_() for name in RATES}
    optimizer = Adam([{"params": [value]} for value in fitted.values()])
    for step, index in track_progress("fitting colors and opacities to pictures of the scene, steps", order, log):
        decay = 0.5 * (1 + math.cos(math.pi * step / len(order)))
        for group, rate in zip(optimizer.param_groups, RATES.values(), strict=True):
            group["lr"] = rate * decay
        rendered = field.render_photo(field.camera_tensors(cameras[index]), field.base_time).encoded
        assert rendered is not None
        optimizer.zero_grad()
        (rendered.clamp(0, 1) - targets[index]).square().mean().backward()
        optimizer.step()
    return to_scene(_arrays_of(field)[0], field.normalization)


@torch.no_grad()
def psnr_of(
    picture: Callable[[Camera], Tensor], reference: Callable[[Camera], Tensor], cameras: Sequence[Camera]
) -> float:
    """Return the PSNR of encoded pictures [H, W, 3] against others, dB, at most 120, over all pixels of the cameras."""
    errors = [float((picture(camera) - reference(camera)).square().mean()) for camera in cameras]
    return -10 * math.log10(max(float(np.mean(errors)), 1e-12))
