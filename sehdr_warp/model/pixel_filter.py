"""The rasterizer's low-pass filter in renders of another resolution than the photos.

The rasterizer adds a variance of EPS2D square pixels to each projected Gaussian. In a training these are pixels of the
photos, and Gaussians are fitted with it. With a longer focal length in pixels, the same variance is less of the scene:
small Gaussians shrink, and a lamp loses most of its light. With a shorter one it is more, and a lamp gains light.
The same holds for pictures from a place that is nearer to a lamp than the photos, and for those of all directions from
one that is farther: there the filter is a part of the scene's sizes.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..rasterizer.projection import FRUSTUM_MARGIN
from ..rasterizer.render_options import EPS2D
from ..scene import Camera
from ..scene.camera import require_camera
from ..scene.wide_camera import pixels_of_directions
from ..subsets import every_nth
from .gaussians import rotate
from .renders import CameraTensors

ROUNDING = 1e-3  # Sizes are whole pixels, so focal lengths of one resolution differ by this.
TOLERANCE = 0.05  # A render that is coarser than the photos by less needs no finer samples.
MOST_CAMERAS, MOST_PROJECTIONS = 128, 1 << 27
"""Cameras that a CPU looks at, or as many as project no more Gaussians in all: with a pinhole, a million of these take
0.06 seconds, with a fisheye 0.1 on any device."""
MOST_AXES = 32  # Photos by whose axes maps order Gaussians
MOST_PIXELS = 1 << 23  # Of a render that is averaged; a wider view is rendered less fine.
ROWS, ROWS_GPU = 1 << 17, 1 << 20  # Gaussians that are projected at once: each takes 100 bytes meanwhile.
NO_PIXEL = 1e6  # Pixels: the focal length of cameras whose pixels have next to no size
NEAR = 1e-6  # Gaussians nearer than this, or behind the camera, are not drawn.
REACH = 3.4  # Standard deviations at which opaque Gaussians end: their alpha is below the threshold.


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
    axes: Tensor | None  # [A, 3] of photo_axes()


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
    gaussians, axes = field.gaussians, photo_axes(field)
    if field.filters is None:
        return PlaceOptions(gaussians.log_scales, opacities, focal_length, pixel_angle, axes)
    offsets = gaussians.means.detach() - place
    distances = offsets.norm(dim=1).clamp_min(NEAR)
    turns = torch.cat([gaussians.quaternions[:, :1], -gaussians.quaternions[:, 1:]], dim=1).detach()
    along = (rotate(turns, offsets) / distances[:, None]).square()
    squares = (2 * gaussians.log_scales.detach()).exp()
    # Of the projection to a plane across the line of sight: determinant and trace of its covariance.
    area = (squares.roll(1, 1) * squares.roll(2, 1) * along).sum(1)
    spread = (squares * (1 - along)).sum(1)
    variances = field.filters.mean.square()
    wider = variances.maximum(EPS2D * (pixel_angle * distances).square())
    in_photos, on_map = (area + each * spread + each.square() for each in (variances, wider))
    log_scales = (squares + wider[:, None]).log() / 2
    shares = (in_photos / on_map).nan_to_num(1.0)  # Of those so large that a square of their area overflows
    return PlaceOptions(log_scales, opacities * shares.sqrt(), NO_PIXEL, 0.0, axes)


def photo_axes(field: Any) -> Tensor | None:
    """Return unit vectors [A, 3] along which pictures of all directions order Gaussians as the photos do.

    What is behind others in all photos is not constrained, and may be in front of them in order of distance: those of
    some of the photos, and of a cube. None without photos, or if some are wide, which order by distance.
    """
    if not field.photo_cameras or not all(camera.is_pinhole for camera in field.photo_cameras):
        return None
    cameras = every_nth(field.photo_cameras, MOST_AXES)
    cube = cameras[len(cameras) // 2].world_to_camera[:3, :3]
    axes = np.concatenate([[camera.world_to_camera[2, :3] for camera in cameras], cube, -cube])
    return torch.tensor(axes, dtype=torch.float32, device=field.gaussians.means.device)


def need_rays(cameras: Sequence[Camera]) -> bool:
    """Return whether pinholes must be drawn along the rays of their pixels, because most photos are not pinholes.

    Such photos train Gaussians by their outlines on the sphere, and in the order of their distances. Linearized, a near
    one beside the view would reach into it, and one behind another could be in front of it.
    """
    return 2 * sum(camera.is_pinhole for camera in cameras) < len(cameras)


def wide_options(
    field: Any, camera: CameraTensors, log_scales: Tensor, opacities: Tensor, at_place: bool
) -> PlaceOptions:
    """Return arguments of rasterize_directions() for a wide camera, `at_place` as options_at_place() does."""
    focal = float(camera.intrinsics[0])
    photos = focal if field.photo_focals is None else field.photo_focals.nearest(focal)
    if at_place:
        return options_at_place(field, camera.position, opacities, photos, 1 / focal)
    return PlaceOptions(log_scales, opacities, photos, 1 / focal, photo_axes(field))


class ViewOptions(NamedTuple):
    """Arguments of rasterize() for a view from any place."""

    log_scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    eps2d: float  # Square pixels
    ray_limit_x: float
    ray_limit_y: float


class RayLimits(NamedTuple):
    """Largest x/z and y/z at which views are linearized, infinite without photos."""

    x: float
    y: float

    @staticmethod
    def of(cameras: Iterable[Camera]) -> "RayLimits":
        """Return those of the cameras that are pinholes, at which the rasterizer linearizes photos."""
        pinholes = [camera for camera in cameras if camera.is_pinhole]
        if not pinholes:
            return RayLimits(math.inf, math.inf)
        sides = [
            (max(c.cx, c.width - c.cx) / c.fx, max(c.cy, c.height - c.cy) / c.fy, c.width / c.fx, c.height / c.fy)
            for c in pinholes
        ]
        x, y, width, height = np.transpose(sides)
        x, y = x + FRUSTUM_MARGIN * width / 2, y + FRUSTUM_MARGIN * height / 2
        return RayLimits(*((1 + ROUNDING) * float(limits.max()) for limits in (x, y)))


WIDE_LIMITS = RayLimits(0.3, 0.3)
"""Limits of pages, which draw no rays, for scenes that need_rays(): views of two rooms gain 3 to 6 dB."""


def options_of_view(
    field: Any, camera: CameraTensors, means: Tensor, log_scales: Tensor, quaternions: Tensor, opacities: Tensor
) -> ViewOptions:
    """Return arguments with which a view of any resolution, from any place, has the light of the photos.

    Gaussians that the view resolves finer than every photo are enlarged: they are filtered as in the finest photo. In a
    view that is wider than all photos, those beside what a photo shows are linearized as in the photos, which were
    trained to be right with it: linearized at their own rays, they would reach into its middle.

    Args:
        field: A RadianceField.
        camera: Of the view.
        means: [N, 3] of the Gaussians.
        log_scales: [N, 3].
        quaternions: [N, 4], w first.
        opacities: [N].
    """
    limits = field.ray_limits if field.photo_cameras else RayLimits.of(())
    if field.photo_focals is None or field.antialiased:  # Which keeps the light at every resolution
        return ViewOptions(log_scales, opacities, EPS2D, *limits)
    fx, fy = camera.intrinsics[:2].tolist()
    variance = field.photo_focals.variance(fx)
    least = None if field.filters is None else field.filters.least
    if least is not None:
        local = means.detach() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        areas = _pixel_areas(local, fx, fy, camera.directions is None)
        deficits = (least.square() - variance * areas).nan_to_num(0).clamp_min(0)[:, None]
        log_scales = torch.logaddexp(2 * log_scales, deficits.log()) / 2  # Unchanged, to the bit, by 0
    if variance < EPS2D and camera.directions is None:
        opacities = keep_light(opacities, means, log_scales, quaternions, camera, variance)
    return ViewOptions(log_scales, opacities, max(variance, EPS2D), *limits)


class PhotoFilters(NamedTuple):
    """Standard deviations [N] of the photos' filter where Gaussians are, in their unit."""

    mean: Tensor  # Geometric mean of the photos that show the place, or that of the nearest photo if none does
    least: Tensor | None  # Of the photo that shows any part of it finest, 0 if none does; None without photos


def filters_of(field: Any) -> PhotoFilters | None:
    """Return the filters of a field's Gaussians, as its file states them or by its photos' cameras.

    None if neither is known, or if opacities make up for the filter.
    """
    means, of_file = field.gaussians.means.detach(), field.photo_filters
    if field.antialiased:
        return None
    filters = None
    if field.photo_cameras:
        cameras = [field.normalization.camera(camera) for camera in field.photo_cameras]
        sizes = field.gaussians.log_scales.detach().amax(1).exp()
        filters = photo_filters(means, cameras, sizes, field.render_device)
    if of_file is not None:
        mean = torch.tensor(of_file, dtype=torch.float32, device=means.device)
        filters = PhotoFilters(mean, filters and filters.least)
    return filters and filters._replace(mean=filters.mean.clamp_min(NEAR))


def samples_across_pixel(field: Any, camera: Camera) -> int:
    """Return how many times finer than a camera's pixels a scene must be rendered to give lamps the photos' light.

    1 for cameras that are not pinholes, and without photos. A wide view has at most MOST_PIXELS finer ones.

    Args:
        field: A RadianceField or PagedField.
        camera: In any coordinates.
    """
    require_camera(camera)
    if field.photo_focals is None or field.antialiased or not camera.is_pinhole:
        return 1
    resolves_photos = math.ceil(field.photo_focals.least / camera.fx - TOLERANCE)
    return max(1, min(resolves_photos, math.isqrt(MOST_PIXELS // camera.pixel_count)))


def photo_filters(
    means: Tensor, cameras: Sequence[Camera], sizes: Tensor | None = None, device: torch.device | str | None = None
) -> PhotoFilters:
    """Return the photos' filter where Gaussians are, float32.

    A round Gaussian as large as a camera's filter covers the area of that filter.

    Args:
        means: [N, 3] in the cameras' coordinates.
        cameras: Training cameras, one or more; of many, a CPU looks at a part, see MOST_CAMERAS.
        sizes: [N] largest standard deviations, by default those of points.
        device: To compute on, by default that of the means.
    """
    device = torch.device(device or means.device)
    if device.type == "cpu" or not all(camera.is_pinhole for camera in cameras):
        cameras = every_nth(cameras, max(MOST_CAMERAS, MOST_PROJECTIONS // max(len(means), 1)))
    rows = ROWS if device.type == "cpu" else ROWS_GPU
    sizes = torch.zeros_like(means[:, 0]) if sizes is None else sizes
    with torch.autocast(device.type, enabled=False):  # They are kept for later renders.
        parts = [
            _filters_of_part(part.to(device), part_sizes.to(device), cameras)
            for part, part_sizes in zip(means.split(rows), sizes.split(rows), strict=True)
        ]
    mean, least = (torch.cat(parts).to(means.device, torch.float32) for parts in zip(*parts, strict=True))
    return PhotoFilters(mean, least)


def _filters_of_part(means: Tensor, sizes: Tensor, cameras: Sequence[Camera]) -> tuple[Tensor, Tensor]:
    """Return photo_filters() of some Gaussians, in the type of their means."""
    count, logarithms = means.new_zeros(len(means)), means.new_zeros(len(means))
    least = means.new_full((len(means),), math.inf)
    for camera in cameras:
        pose = means.new_tensor(camera.world_to_camera)
        local = means @ pose[:3, :3].T + pose[:3, 3]
        areas, beyond = _pixel_areas(local, camera.fx, camera.fy, camera.is_pinhole), _pixels_beyond(local, camera)
        visible = (beyond <= 0) & (areas < math.inf)
        logarithms += areas.log().masked_fill_(~visible, 0)
        count += visible
        # Along the radius, a pinhole's picture is enlarged by more.
        tilts = local.norm(dim=1) / local[:, 2].clamp_min(NEAR) if camera.is_pinhole else 1.0
        reach = REACH * (sizes.square() / areas * tilts + EPS2D).sqrt()
        least = least.minimum(areas.masked_fill(~(beyond <= reach), math.inf))
    least = least.masked_fill(least == math.inf, 0)
    mean = (logarithms / count.clamp_min(1)).exp()
    if len(elsewhere := (count == 0).nonzero()[:, 0]):
        from scipy.spatial import KDTree

        angles = np.array([camera.fx * camera.fy for camera in cameras])
        nearest, index = KDTree(np.stack([camera.position for camera in cameras])).query(means[elsewhere].cpu().numpy())
        mean[elsewhere] = means.new_tensor(np.maximum(nearest, NEAR) ** 2 / angles[index])
    # Rounding must not make it larger than the pixels of the finest photo itself.
    return (EPS2D * mean).sqrt(), (EPS2D * least).sqrt() * (1 - ROUNDING)


def _pixel_areas(local: Tensor, fx: float, fy: float, is_pinhole: bool) -> Tensor:
    """Return what areas [N] a pixel covers of spheres about a camera through positions [N, 3] in its axes."""
    areas = local.square().sum(1).clamp_min(NEAR**2)
    if is_pinhole:  # depth^3 / distance instead of distance^2
        areas = local[:, 2].clamp_min(NEAR) ** 3 * areas.rsqrt()
    return areas / (fx * fy)


def _pixels_beyond(local: Tensor, camera: Camera) -> Tensor:
    """Return how many pixels [N] positions [N, 3], in a camera's axes, are outside of its picture.

    At most 0 within it, infinite where the lens does not look; occlusion is not considered.
    """
    if camera.projection == "equirectangular":
        return local.new_zeros(len(local))
    width, height = camera.width, camera.height
    if camera.is_pinhole:
        x, y, depth = local.unbind(1)
        columns, rows = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        hidden = depth <= NEAR
    else:
        size = {"width": 3 * width, "height": 3 * height, "cx": camera.cx + width, "cy": camera.cy + height}
        places = pixels_of_directions(local.double().cpu().numpy(), replace(camera, **size))
        rows, columns = torch.from_numpy(places + 0.5).to(local).unbind(1)
        rows, columns = rows - height, columns - width
        hidden = columns.isnan()
    outside = torch.maximum((columns - width / 2).abs() - width / 2, (rows - height / 2).abs() - height / 2)
    return outside.masked_fill(hidden | outside.isnan(), math.inf)


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
