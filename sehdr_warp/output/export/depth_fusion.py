"""Surfaces from the depth of many views: a truncated signed distance field (Curless and Levoy, 1996) and its zero."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ...errors import SehdrError, require_extra
from ...progress import track_progress
from ...runs.run import RenderableScene
from ...scene import Camera
from ...scene.wide_camera import face_cameras, face_size, surface_points
from ..world_transform import WorldTransform
from .splat_edits import Box, Sphere

log = logging.getLogger(__name__)
MOST_VIEWS, _VIEW_SIZE = 40, 400  # Training views that are fused, and their longest side in pixels
_TRUNCATION = 6.0  # Voxels around the surface in which the distance is not clamped; 3 leaves holes in short trainings
_EDGE = 0.08  # Relative depth step to a neighboring pixel from which depth is a mean over an edge, and is not used
_LEAST_ALPHA = 0.5
_PERCENTILES, _FAR = (2, 98), 2.5  # Of the points within this many times the median depth: the box without a crop
_CHUNK = 1 << 20  # Voxels at once


@dataclass(frozen=True)
class DepthView:
    """A pinhole camera in the file's coordinates, its depth [H, W] (0 where it is not known) and radiance [H, W, 3]."""

    camera: Camera
    depth: torch.Tensor
    radiance: torch.Tensor


def depth_views(
    run: RenderableScene, camera: Camera, transform: WorldTransform, size: int = _VIEW_SIZE
) -> list[DepthView]:
    """Render a camera's depth, at most `size` pixels long: one view of a pinhole, the faces of a wide camera.

    Depth at edges, where little covers the pixel, and where a lens shows nothing is 0.
    """
    if camera.is_pinhole:
        return [_depth_view(run, camera.within(size), transform)]
    faces = face_cameras(camera, min(face_size(camera), max(size // 2, 16)))
    views = [_depth_view(run, face.camera, transform) for face in faces]
    return [
        replace(view, depth=view.depth * torch.from_numpy(face.visible))
        for view, face in zip(views, faces, strict=True)
    ]


def _depth_view(run: RenderableScene, camera: Camera, transform: WorldTransform) -> DepthView:
    rendered = run.render(camera)
    depth = np.where(rendered.alpha.cpu().numpy() > _LEAST_ALPHA, rendered.depth.cpu().numpy(), 0) * transform.scale
    flat = np.ones(depth.shape, bool)
    for values, smooth in ((depth, flat), (depth.T, flat.T)):
        step = np.abs(np.diff(values, axis=0)) > _EDGE * np.minimum(values[:-1], values[1:])
        smooth[:-1] &= ~step
        smooth[1:] &= ~step
    depth = torch.from_numpy(np.where(flat, depth, 0).astype(np.float32))
    return DepthView(transform.camera(camera), depth, torch.from_numpy(np.array(rendered.hdr.cpu().numpy())))


def points_of_view(view: DepthView) -> np.ndarray:
    """Return the points [N, 3] of a view's depth."""
    depth = view.depth.numpy()
    return surface_points(view.camera, depth)[depth > 0]


def mesh_bounds(views: Sequence[DepthView], region: Box | Sphere | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box to mesh: that of the region, or of what most views show, but not far behind."""
    if isinstance(region, Box):
        return region.low, region.high
    if isinstance(region, Sphere):
        return region.center - region.radius, region.center + region.radius
    depths = np.concatenate([view.depth[view.depth > 0].numpy() for view in views])
    if not depths.size:
        raise SehdrError("no view shows a surface to mesh; was the training long enough?")
    near = float(np.median(depths)) * _FAR
    points = np.concatenate(
        [points_of_view(replace(view, depth=torch.where(view.depth < near, view.depth, 0)))[::7] for view in views]
    )
    low, high = (np.percentile(points, q, axis=0) for q in _PERCENTILES)
    margin = 0.03 * (high - low).max()
    return low - margin, high + margin


def voxel_centers(low: np.ndarray, voxel: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return the centers of all voxels, [X, Y, Z, 3]; `voxel` are the sides [3] of one."""
    axes = [low[axis] + voxel[axis] * np.arange(count) for axis, count in enumerate(shape)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def fuse_depth(
    views: Sequence[DepthView], low: np.ndarray, voxel: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fuse the views' depth, in voxels with sides [3] whose first center is `low` [3].

    Returns:
        Signed distance to the surface in truncation lengths, in [-1, 1] and positive outside; number of views that
        measured a voxel; mean radiance near the surface. [X, Y, Z] and [X, Y, Z, 3].
    """
    count = int(np.prod(shape))
    distance, weight = torch.zeros(count), torch.zeros(count)
    light, near = torch.zeros(count, 3), torch.zeros(count)
    reach = _TRUNCATION * float(voxel.max())
    for _, view in track_progress("fusing depth of views", views, log):
        camera = view.camera
        turn = torch.tensor(camera.world_to_camera, dtype=torch.float32)
        for start, points in _chunks(low, voxel, shape):
            part = slice(start, start + len(points))
            x, y, z = (points @ turn[:3, :3].T + turn[:3, 3]).unbind(1)
            ahead = z > 1e-6
            safe = torch.where(ahead, z, torch.ones_like(z))
            column = (camera.fx * x / safe + camera.cx).floor().long()
            row = (camera.fy * y / safe + camera.cy).floor().long()
            ahead &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            index = torch.where(ahead, row * camera.width + column, torch.zeros_like(row))
            depth = view.depth.reshape(-1)[index]
            signed = (depth - z) / reach
            has_depth = ahead & (depth > 0) & (signed > -1)
            distance[part] += torch.where(has_depth, signed.clamp(-1, 1), 0)
            weight[part] += has_depth
            close = has_depth & (signed < 1)
            light[part] += view.radiance.reshape(-1, 3)[index] * close[:, None]
            near[part] += close
    mean = distance / weight.clamp_min(1)
    colors = light / near.clamp_min(1)[:, None]
    return mean.reshape(shape).numpy(), weight.reshape(shape).numpy(), colors.reshape(*shape, 3).numpy()


def _chunks(low: np.ndarray, voxel: np.ndarray, shape: tuple[int, ...]) -> Iterator[tuple[int, torch.Tensor]]:
    """Yield the first index and the centers [N, 3] of slabs of voxels."""
    slab = shape[1] * shape[2]
    step = max(1, _CHUNK // slab)
    for first in range(0, shape[0], step):
        part = (min(step, shape[0] - first), *shape[1:])
        origin = low + np.array([first * voxel[0], 0, 0])
        yield first * slab, torch.from_numpy(voxel_centers(origin, voxel, part).reshape(-1, 3)).float()


def zero_surface(distance: np.ndarray, has_depth: np.ndarray, voxel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [V, 3], from the first voxel, and faces [F, 3] of the zero of a distance field."""
    try:
        # Renderers compute no normals for triangles without area.
        options = {"mask": has_depth, "gradient_direction": "descent", "allow_degenerate": False}
        surface = marching_cubes_function()(distance, 0.0, spacing=tuple(voxel), **options)
    except (ValueError, RuntimeError):  # Nothing of the field is measured, or it has no zero.
        raise SehdrError("there is no surface to mesh; take another --crop, or train longer") from None
    vertices, faces = surface[:2]
    finite = np.isfinite(vertices).all(axis=1)
    faces = faces[finite[faces].all(axis=1)]
    # Blender calls a mesh invalid whose triangles have a corner twice, or are there twice.
    corners = np.sort(faces, axis=1)
    once = np.zeros(len(faces), bool)
    once[np.unique(corners, axis=0, return_index=True)[1]] = True
    return vertices, faces[once & (np.diff(corners, axis=1) > 0).all(axis=1)]


def marching_cubes_function() -> Any:
    """Return scikit-image's marching cubes; raise SehdrError if it is not installed."""
    return require_extra("skimage.measure", "meshes need scikit-image", "mesh").marching_cubes


def nearest_values(volume: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the values of a volume [X, Y, Z, 3] at the voxels nearest to places [V, 3]."""
    index = np.clip(np.rint(places).astype(int), 0, np.array(volume.shape[:3]) - 1)
    return volume[tuple(index.T)]
