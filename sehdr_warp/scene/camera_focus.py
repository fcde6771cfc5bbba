"""Find the point where the axes of cameras meet, and the place from which to look around."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .camera import Camera

# Mean squared sine between optical axes below which they are parallel in effect: where they meet is then chance, as of
# photos from the air that look down (6 degrees).
_PARALLEL = np.sin(np.radians(6)) ** 2
# Photos walk around what they look at if most of them look at it within this cosine and they stand on all sides of it;
# what is nearer to it than this part of the distance of the nearest camera is then left out of a map at the center.
_FACING, _SIDES, _CLEARANCE = 0.7, 0.5, 0.5


class MapCenter(NamedTuple):
    """Position from which a map of a whole scene is rendered, and what is left out of it."""

    position: np.ndarray  # [3], scene coordinates
    beyond: float  # Distance within which Gaussians are left out, scene units; 0 leaves out none


def map_center(photos: Sequence[Camera]) -> MapCenter:
    """Return the mean place of the training cameras, or, if they walk around something, what surrounds that.

    There is at least one.
    """
    focus = subject_of_walk(photos)
    if focus is None:
        return MapCenter(np.mean([camera.position for camera in photos], axis=0), 0.0)
    nearest = min(float(np.linalg.norm(camera.position - focus)) for camera in photos)
    return MapCenter(focus, _CLEARANCE * nearest)


def subject_of_walk(photos: Sequence[Camera]) -> np.ndarray | None:
    """Return the point that cameras stand around and look at; None if they do not, as in a room seen from within."""
    focus = common_focus(photos) if len(photos) > 3 else None
    if focus is None:
        return None
    offsets = np.stack([camera.position for camera in photos]) - focus
    distances = np.linalg.norm(offsets, axis=1, keepdims=True)
    if distances.min() <= 1e-6 * distances.max():
        return None
    towards = -offsets / distances
    facing = np.sum(towards * np.stack([camera.world_to_camera[2, :3] for camera in photos]), axis=1)
    # Cameras on one side have a mean direction of nearly unit length, cameras all around one of nearly zero.
    around = np.linalg.norm(towards.mean(0)) < _SIDES
    return focus if np.mean(facing > _FACING) > 0.8 and around else None


def common_focus(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the point [3] nearest to all optical axes (least squares); None if they are parallel or it lies behind."""
    positions, forward = camera_positions(cameras), camera_axes(cameras, 2)
    off_axis = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    matrix = off_axis.mean(axis=0)
    if np.linalg.eigvalsh(matrix)[0] < _PARALLEL:
        return None
    focus = np.linalg.solve(matrix, (off_axis @ positions[:, :, None]).mean(axis=0)[:, 0])
    return focus if np.median(np.sum((focus - positions) * forward, axis=1)) > 0 else None


def camera_positions(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the places [n, 3] of cameras."""
    return np.array([camera.position for camera in cameras]).reshape(-1, 3)


def camera_axes(cameras: Sequence[Camera], axis: int) -> np.ndarray:
    """Return the cameras' x, y or z axes [n, 3] in world coordinates."""
    return np.stack([camera.world_to_camera[axis, :3] for camera in cameras])
