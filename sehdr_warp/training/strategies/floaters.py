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
CELLS = 8  # Cells of a photo across and down. A lawn before a facade has no points, and is nearer than all points
FEWEST_IN_CELL = 5  # A cell with fewer points says nothing about what is near in it
MOST_POINTS = 20_000  # That are looked at


PointDistances = Sequence[Sequence[float]] | Sequence[float]
"""Distances of distances_of_points(): of the cells of each photo, or of whole photos, as earlier checkpoints have."""


class TrainingCameras(NamedTuple):
    """The cameras of the V training photos, in normalized coordinates, and how near the scene is to them."""

    positions: Tensor  # [V, 3]
    world_to_camera: Tensor  # [V, 4, 4]
    intrinsics: Tensor  # [V, 4] fx, fy, cx, cy in pixels
    sizes: Tensor  # [V, 2] width and height in pixels
    nearest_points: Tensor  # [V, CELLS * CELLS] of distances_of_points()

    @staticmethod
    def of_views(views: Sequence[View], distances: PointDistances, device: torch.device | str) -> "TrainingCameras":
        """Return the cameras of views; distances are those of distances_of_points(), or [V], equal in all cells."""
        cameras = [view.camera for view in views]
        by_cell = np.broadcast_to(np.asarray(distances, float).reshape(len(views), -1), (len(views), CELLS * CELLS))
        values = (
            [camera.position for camera in cameras],
            [camera.world_to_camera for camera in cameras],
            [camera.intrinsics for camera in cameras],
            [(camera.width, camera.height) for camera in cameras],
            by_cell,
        )
        return TrainingCameras(*(torch.tensor(np.array(each), dtype=torch.float32, device=device) for each in values))

    def used_by(self, options: McmcConfig) -> "TrainingCameras | None":
        """Return the cameras by which floater_mask() finds floaters, None if there are none."""
        mask = (options.prune_near_points * self.nearest_points > 0).any(1)
        return TrainingCameras(*(each[mask] for each in self)) if mask.any() else None


def distances_of_points(views: Sequence[View], points: np.ndarray) -> list[list[float]]:
    """Return the distances [V, CELLS * CELLS] of the nearest points [P, 3] that a photo shows in each of its cells.

    The MISMATCHES nearest percent do not count, and no distance exceeds that of the whole photo. It is 0 in cells with
    fewer points than FEWEST_IN_CELL, for photos that show FEWEST_POINTS or fewer, and for cameras other than pinholes.
    """
    points, distances = every_nth(points, MOST_POINTS), []
    for camera in (view.camera for view in views):
        by_cell = np.zeros(CELLS * CELLS)
        if camera.is_pinhole:
            pixels = camera.project(points)
            from_camera = np.linalg.norm(points[pixels.inside] - camera.position, axis=1)
            down, across = (
                (place[pixels.inside] * CELLS // size).astype(int)
                for place, size in ((pixels.row, camera.height), (pixels.column, camera.width))
            )
            if len(from_camera) > FEWEST_POINTS:
                nearest, cells = np.percentile(from_camera, MISMATCHES), down * CELLS + across
                for cell in np.flatnonzero(np.bincount(cells) >= FEWEST_IN_CELL):
                    by_cell[cell] = min(nearest, np.percentile(from_camera[cells == cell], MISMATCHES))
        distances.append(by_cell.round(6).tolist())
    return distances


def floater_mask(gaussians: Gaussians, cameras: TrainingCameras, options: McmcConfig) -> Tensor:
    """Return a mask [N] of floaters: in a cell of a photo, nearer than prune_near_points times its nearest points.

    Compare the occlusion loss of FreeNeRF (CVPR 2023), which takes density next to the cameras away.
    """
    near = []
    least = options.prune_near_points * cameras.nearest_points
    for means in gaussians.means.detach().split(max(1, DISTANCES_AT_ONCE // len(cameras.positions))):
        # Not torch.cdist(), which on a GPU takes 256 threads for each distance.
        squares = sum((means[:, axis, None] - cameras.positions[:, axis]).square_() for axis in range(3))
        assert isinstance(squares, Tensor)
        rows, views = (squares < least.amax(1).square()).nonzero(as_tuple=True)
        cells, in_view = _cells_of(means[rows], views, cameras)
        in_front = in_view & (squares[rows, views] < least[views, cells].square())
        near.append(torch.zeros(len(means), dtype=torch.bool, device=means.device).index_fill_(0, rows[in_front], True))
    return torch.cat(near)


def _cells_of(points: Tensor, views: Tensor, cameras: TrainingCameras) -> tuple[Tensor, Tensor]:
    """Return the cells [P] of photos that points [P, 3] fall on, and whether the views [P] of the cameras contain them.

    Points outside of a view get cell 0.
    """
    world_to_camera, intrinsics, sizes = cameras.world_to_camera[views], cameras.intrinsics[views], cameras.sizes[views]
    local = (world_to_camera[:, :3, :3] @ points[:, :, None])[..., 0] + world_to_camera[:, :3, 3]
    pixels = intrinsics[:, :2] * local[:, :2] / local[:, 2:] + intrinsics[:, 2:]
    in_view = (local[:, 2] > 0) & (pixels > 0).all(1) & (pixels < sizes).all(1)
    places = torch.where(in_view[:, None], pixels * CELLS / sizes, 0).long().clamp_max(CELLS - 1)
    return places[:, 1] * CELLS + places[:, 0], in_view
