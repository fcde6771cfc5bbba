"""Choose where an environment map is rendered from, and what it leaves out."""

import logging
from typing import TYPE_CHECKING

import numpy as np

from ...errors import SehdrError, require_number
from ...scene.camera_focus import MapCenter, map_center
from ..cameras.scene_cameras import find_view, training_cameras
from ..world_transform import WorldTransform

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

log = logging.getLogger(__name__)


def find_center(
    run: "RenderableScene", at: str | tuple[float, float, float], beyond: float | None, transform: WorldTransform
) -> MapCenter:
    """Return where a map is rendered and what it leaves out, by the arguments of write_environment_map()."""
    if isinstance(at, str) and at == "center":
        if not (photos := training_cameras(run)):
            raise SehdrError("the scene has no cameras, so no center; say where with --at x,y,z")
        center = map_center(photos)
    elif isinstance(at, str) and at.startswith("camera:"):
        center = MapCenter(find_view(run, at.removeprefix("camera:")).camera.position, 0.0)
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


def check_beyond(beyond: float | None) -> None:
    """Raise SehdrError for a distance that is negative or not finite."""
    if beyond is not None:
        require_number(beyond, "beyond")
    if beyond is not None and not 0 <= beyond < np.inf:
        raise SehdrError(f"beyond {beyond:g} is not a distance; give 0 or more, in the units of exported files")


def check_place(at: str) -> None:
    """Raise SehdrError for a place that is nothing that `--at` takes, before a scene is opened."""
    if at != "center" and not at.startswith("camera:"):
        _numbers(at)
