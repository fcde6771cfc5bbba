"""Floaters: Gaussians before the training cameras where the scene has no surface."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...model.gaussians import Gaussians
from ...runs.config import McmcConfig
from ...scene import View
from ...subsets import every_nth

DISTANCES_AT_ONCE = 1 << 22  # Gaussian-camera distances in memory at once
MISMATCHES = 2.0  # Percent of the points of a photo, the nearest ones, that do not count: some are mismatches
FEWEST_POINTS = 20  # A photo that shows fewer points says nothing about what is near
MOST_POINTS = 20_000  # That are looked at


class TrainingCameras(NamedTuple):
    """The cameras of the V training photos, in normalized coordinates, and how near the scene is to them."""

    positions: Tensor  # [V, 3]
    world_to_camera: Tensor  # [V, 4, 4]
    intrinsics: Tensor  # [V, 4] fx, fy, cx, cy in pixels
    sizes: Tensor  # [V, 2] width and height in pixels
    nearest_points: Tensor  # [V] of distances_of_points()

    @staticmethod
    def of_views(views: Sequence[View], distances: Sequence[float], device: torch.device | str) -> "TrainingCameras":
        """Return the cameras of views; distances [V] are those of distances_of_points()."""
        cameras = [view.camera for view in views]
        values = (
            [camera.position for camera in cameras],
            [camera.world_to_camera for camera in cameras],
            [camera.intrinsics for camera in cameras],
            [(camera.width, camera.height) for camera in cameras],
            distances,
        )
        return TrainingCameras(*(torch.tensor(np.array(each), dtype=torch.float32, device=device) for each in values))

    def used_by(self, options: McmcConfig) -> "TrainingCameras | None":
        """Return the cameras by which floater_mask() finds floaters, None if there are none."""
        mask = options.prune_near_points * self.nearest_points > 0
        return TrainingCameras(*(each[mask] for each in self)) if mask.any() else None


def distances_of_points(views: Sequence[View], points: np.ndarray) -> list[float]:
    """Return the distances [V] of the points [P, 3] that are nearest to the camera of a photo and in its view.

    The MISMATCHES nearest percent do not count. The distance is 0 for photos that show FEWEST_POINTS or fewer, and for
    cameras other than pinholes.
    """
    points, distances = every_nth(points, MOST_POINTS), []
    for camera in (view.camera for view in views):
        in_view = points[camera.project(points).inside] if camera.is_pinhole else points[:0]
        from_camera = np.linalg.norm(in_view - camera.position, axis=1)
        distances.append(float(np.percentile(from_camera, MISMATCHES)) if len(in_view) > FEWEST_POINTS else 0.0)
    return distances


def floater_mask(gaussians: Gaussians, cameras: TrainingCameras, options: McmcConfig) -> Tensor:
    """Return a mask [N] of floaters: in the view of a camera, nearer than prune_near_points times the nearest points.

    Compare the occlusion loss of FreeNeRF (CVPR 2023), which takes density next to the cameras away.
    """
    near = []
    least = options.prune_near_points * cameras.nearest_points
    for means in gaussians.means.detach().split(max(1, DISTANCES_AT_ONCE // len(cameras.positions))):
        # Not torch.cdist(), which on a GPU takes 256 threads for each distance.
        squares = sum((means[:, axis, None] - cameras.positions[:, axis]).square_() for axis in range(3))
        assert isinstance(squares, Tensor)
        rows, views = (squares < least.square()).nonzero(as_tuple=True)
        in_view = _in_view(means[rows], views, cameras)
        near.append(torch.zeros(len(means), dtype=torch.bool, device=means.device).index_fill_(0, rows[in_view], True))
    return torch.cat(near)


def _in_view(points: Tensor, views: Tensor, cameras: TrainingCameras) -> Tensor:
    """Return for points [P, 3] whether the views [P] of pinhole cameras contain them, bool [P]."""
    world_to_camera, intrinsics = cameras.world_to_camera[views], cameras.intrinsics[views]
    local = (world_to_camera[:, :3, :3] @ points[:, :, None])[..., 0] + world_to_camera[:, :3, 3]
    pixels = intrinsics[:, :2] * local[:, :2] / local[:, 2:] + intrinsics[:, 2:]
    return (local[:, 2] > 0) & (pixels > 0).all(1) & (pixels < cameras.sizes[views]).all(1)
