"""The rasterizer's low-pass filter in renders of another resolution than the photos.

The rasterizer adds a variance of EPS2D square pixels to each projected Gaussian. In a training these are pixels of the
photos, and Gaussians are fitted with it. With a longer focal length in pixels, the same variance is less of the scene:
small Gaussians shrink, and a lamp loses most of its light. With a shorter one it is more, and a lamp gains light.
The same holds for pictures of all directions from a place that is nearer to a lamp than the photos, or farther: there
the filter is a part of the scene's sizes.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..rasterizer.render_options import EPS2D
from ..scene import Camera
from ..scene.wide_camera import pixels_of_directions
from ..subsets import every_nth
from .gaussians import rotate
from .renders import CameraTensors

ROUNDING = 1e-3  # Sizes are whole pixels, so focal lengths of one resolution differ by this.
TOLERANCE = 0.05  # A render that is coarser than the photos by less needs no finer samples.
MOST_CAMERAS = 128  # Each takes about a tenth of a second for a million Gaussians.
PLACE_CAMERAS = 32  # The same for pictures from a place, which otherwise take seconds
MOST_PIXELS = 1 << 23  # Of a render that is averaged; a wider view is rendered less fine.
ROWS = 1 << 17  # Gaussians that are projected at once: each takes 140 bytes meanwhile.
NO_PIXEL = 1e6  # Pixels: the focal length of cameras whose pixels have next to no size
NEAR = 1e-6  # Gaussians nearer than this, or behind the camera, are not drawn.


class FocalRange(NamedTuple):
    """Focal lengths of the photos of a training, pixels."""

    least: float
    most: float

    @staticmethod
    def of(cameras: Iterable[Camera]) -> "FocalRange | None":
        """Return the range of the cameras' focal lengths; None without cameras."""
        focals = [camera.fx for camera in cameras]
        return FocalRange(min(focals), max(focals)) if focals else None

    def nearest(self, focal: float) -> float:
        """Return the focal length of the range that is nearest to another."""
        return min(max(focal, self.least), self.most)

    def variance(self, focal: float) -> float:
        """Return the variance of the photos' filter in square pixels of a render with a focal length in pixels."""
        ratio = focal / self.nearest(focal)
        return EPS2D if abs(ratio - 1) < ROUNDING else EPS2D * ratio**2


class PlaceOptions(NamedTuple):
    """Arguments of rasterize_directions() for a picture from any place."""

    log_scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    focal_length: float  # Pixels
    pixel_angle: float  # Radians


def options_at_place(
    field: Any, place: Tensor, opacities: Tensor, focal_length: float, pixel_angle: float
) -> PlaceOptions:
    """Return arguments with which Gaussians are as large, from any place, as the photos show them.

    Those that are smaller than a pixel from there are enlarged to it and keep their light. Unchanged if the photos'
    filter is not known, or if opacities make up for it.

    Args:
        field: A RadianceField.
        place: [3], in the unit of its Gaussians.
        opacities: [N] of these.
        focal_length: Of the photos, pixels.
        pixel_angle: Of the picture's pixels, radians.
    """
    gaussians, filters = field.gaussians, field.filters
    if filters is None:
        return PlaceOptions(gaussians.log_scales, opacities, focal_length, pixel_angle)
    offsets = gaussians.means.detach() - place
    distances = offsets.norm(dim=1).clamp_min(NEAR)
    turns = torch.cat([gaussians.quaternions[:, :1], -gaussians.quaternions[:, 1:]], dim=1).detach()
    along = (rotate(turns, offsets) / distances[:, None]).square()
    squares = (2 * gaussians.log_scales.detach()).exp()
    # Of the projection to a plane across the line of sight: determinant and trace of its covariance.
    area = (squares.roll(1, 1) * squares.roll(2, 1) * along).sum(1)
    spread = (squares * (1 - along)).sum(1)
    variances = filters.square()
    wider = variances.maximum(EPS2D * (pixel_angle * distances).square())
    in_photos, on_map = (area + each * spread + each.square() for each in (variances, wider))
    log_scales = (squares + wider[:, None]).log() / 2
    shares = (in_photos / on_map).nan_to_num(1.0)  # Of those so large that a square of their area overflows
    return PlaceOptions(log_scales, opacities * shares.sqrt(), NO_PIXEL, 0.0)


def filters_of(field: Any) -> Tensor | None:
    """Return the filters [N] of a field's Gaussians in their unit, as its file states them or by its photos' cameras.

    None if neither is known, or if opacities make up for the filter.
    """
    filters, means = field.photo_filters, field.gaussians.means
    if field.antialiased:
        return None
    if filters is None and field.photo_cameras:
        places = field.normalization.scene_points(means.detach().double().cpu().numpy())
        filters = photo_filters(places, every_nth(field.photo_cameras, PLACE_CAMERAS)) / field.normalization.unit
    return None if filters is None else torch.tensor(filters, dtype=torch.float32, device=means.device).clamp_min(NEAR)


def samples_across_pixel(field: Any, camera: Camera) -> int:
    """Return how many times finer than a camera's pixels a scene must be rendered to give lamps the photos' light.

    1 for cameras that are not pinholes, and without photos. A wide view has at most MOST_PIXELS finer ones.

    Args:
        field: A RadianceField or PagedField.
        camera: In any coordinates.
    """
    if field.photo_focals is None or field.antialiased or not camera.is_pinhole:
        return 1
    resolves_photos = math.ceil(field.photo_focals.least / camera.fx - TOLERANCE)
    return max(1, min(resolves_photos, math.isqrt(MOST_PIXELS // camera.pixel_count)))


def photo_filters(means: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the standard deviations [N] of the photos' filter where Gaussians are, in scene units.

    It is the geometric mean of those of the cameras that have the place in their picture, or that of the nearest camera
    if none has; of more than MOST_CAMERAS, a part is asked. A round Gaussian as large as a camera's filter covers the
    area of that filter.

    Args:
        means: [N, 3] scene coordinates.
        cameras: Training cameras, one or more.
    """
    from scipy.spatial import KDTree

    if len(means) > ROWS:
        parts = np.split(means, range(ROWS, len(means), ROWS))
        return np.concatenate([photo_filters(part, cameras) for part in parts])
    angles = np.array([1 / math.sqrt(camera.fx * camera.fy) for camera in cameras])
    nearest, index = KDTree(np.stack([camera.position for camera in cameras])).query(means)
    count, logarithms = np.zeros(len(means)), np.zeros(len(means))
    for camera, angle in zip(every_nth(cameras, MOST_CAMERAS), every_nth(angles, MOST_CAMERAS), strict=True):
        if camera.is_pinhole:
            projected = camera.project(means)
            rows = np.flatnonzero(projected.inside)
            tilts = np.log(projected.depth[rows])
        else:
            local = means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
            rows, tilts = np.flatnonzero(np.isfinite(pixels_of_directions(local, camera)).all(axis=1)), 0.0
        distances = np.log(np.maximum(np.linalg.norm(means[rows] - camera.position, axis=1), NEAR))
        # A pixel covers depth^3 / (distance fx fy) of a sphere about the camera at this distance.
        logarithms[rows] += math.log(angle) + (1.5 * tilts - 0.5 * distances if camera.is_pinhole else distances)
        count[rows] += 1
    pixels = np.where(count > 0, np.exp(logarithms / np.maximum(count, 1)), np.maximum(nearest, NEAR) * angles[index])
    return (math.sqrt(EPS2D) * pixels).astype(np.float32)


def keep_light(
    opacities: Tensor, means: Tensor, log_scales: Tensor, quaternions: Tensor, camera: CameraTensors, variance: float
) -> Tensor:
    """Return opacities [N] with which Gaussians filtered by EPS2D give the light that they give if filtered by less.

    As the opacity compensation of Mip-Splatting (Yu et al. 2024), with `variance` in place of no filter: the opacity
    times the area of the projected Gaussian stays.

    Args:
        opacities: [N].
        means: [N, 3].
        log_scales: [N, 3].
        quaternions: [N, 4], w first.
        camera: A pinhole camera.
        variance: Of the filter in training, square pixels of this camera; at most EPS2D.
    """
    pose, (fx, fy, _, _) = camera.world_to_camera, camera.intrinsics
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    z = z.clamp_min(NEAR)
    zero = torch.zeros_like(z)
    # Rows of the derivative of the pixel by the position, in world axes.
    across = torch.stack([fx / z, zero, -fx * x / z**2], 1) @ pose[:3, :3]
    down = torch.stack([zero, fy / z, -fy * y / z**2], 1) @ pose[:3, :3]
    scales = log_scales.exp()
    inverse = torch.cat([quaternions[:, :1], -quaternions[:, 1:]], dim=1)
    across, down = (rotate(inverse, row) * scales for row in (across, down))
    area, spread = torch.linalg.cross(across, down).square().sum(1), (across**2 + down**2).sum(1)
    in_photos, in_render = (area + each * spread + each * each for each in (variance, EPS2D))
    return opacities * (in_photos / in_render).nan_to_num(1.0).sqrt()
