"""Choose where an environment map is rendered from, and what it leaves out."""

import logging
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...errors import SehdrError
from ...scene import Camera
from ..cameras.scene_cameras import camera_named, common_focus, training_cameras
from ..world_transform import WorldTransform

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

log = logging.getLogger(__name__)
# Photos walk around what they look at if most of them look at it within this cosine and they stand on all sides of it;
# what is nearer to it than this part of the distance of the nearest camera is then left out of a map at the center.
_FACING, _SIDES, _CLEARANCE = 0.7, 0.5, 0.5


class MapCenter(NamedTuple):
    """Position from which a map of a whole scene is rendered, and what is left out of it."""

    position: np.ndarray  # [3], scene coordinates
    beyond: float  # Distance within which Gaussians are left out, scene units; 0 leaves out none


def map_center(photos: list[Camera]) -> MapCenter:
    """Return the mean place of the training cameras, or, if they walk around something, what surrounds that.

    Raises SehdrError without cameras.
    """
    if not photos:
        raise SehdrError("the scene has no cameras, so no center; say where with --at x,y,z")
    focus = subject_of_walk(photos)
    if focus is None:
        return MapCenter(np.mean([camera.position for camera in photos], axis=0), 0.0)
    nearest = min(float(np.linalg.norm(camera.position - focus)) for camera in photos)
    return MapCenter(focus, _CLEARANCE * nearest)


def find_center(
    run: "RenderableScene", at: str | tuple[float, float, float], beyond: float | None, transform: WorldTransform
) -> MapCenter:
    """Return where a map is rendered and what it leaves out, by the arguments of write_environment_map()."""
    if isinstance(at, str) and at == "center":
        center = map_center(training_cameras(run))
    elif isinstance(at, str) and at.startswith("camera:"):
        center = MapCenter(camera_named(run, at.removeprefix("camera:")).position, 0.0)
    else:
        center = MapCenter(transform.inverse().points(_numbers(at)), 0.0)
    if beyond is not None:
        return center._replace(beyond=beyond / transform.scale)
    if center.beyond:
        place = ", ".join(f"{value:.4g}" for value in transform.points(center.position))
        text = "the photos walk around (%s): the map is what surrounds that point beyond %.3g; --beyond changes it"
        log.info(text, place, transform.scale * center.beyond)
    return center


def _numbers(at: str | tuple[float, float, float]) -> np.ndarray:
    """Return the three numbers of a point [3]; raise SehdrError for anything else."""
    try:
        position = np.array([float(v) for v in (at.split(",") if isinstance(at, str) else at)])
    except (ValueError, TypeError):
        position = np.array([])
    if position.shape != (3,) or not np.isfinite(position).all():
        raise SehdrError(f"point {at!r} is neither x,y,z nor camera:NAME nor center; set --at, for example to 0,0,1.5")
    return position


def check_place(at: str) -> None:
    """Raise SehdrError for a place that is nothing that `--at` takes, before a scene is opened."""
    if at != "center" and not at.startswith("camera:"):
        _numbers(at)


def subject_of_walk(photos: list[Camera]) -> np.ndarray | None:
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
