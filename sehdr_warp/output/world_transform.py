"""The similarity from a scene's coordinates to those of files: upright, and scaled to meters.

    photos' coordinates  -- photos_to_scene() -->  scene's coordinates  -- world_transform() -->  coordinates of files
    photos' coordinates  --------------------------- photos_to_file() ------------------------->  coordinates of files

A scene's coordinates are those of its cameras and renders: the photos' own for a run, the file's for a file of
Gaussians. Pictures, Gaussians, maps, lights, meshes, cameras.usda and .chan share the transform, so that they line up
in another program; PLY, SOG and SPZ are turned over, and JSON cameras stay in the photos' coordinates. It depends on
the cameras of the scene alone, so it stays the same when a training goes on. Files store the matrix from the photos'
coordinates to theirs.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import InputError, SehdrError, require_loaded
from ..files import read_json, write_json
from ..runs.values import ORIENTATION_FILE
from ..scene import Camera
from ..scene.camera_focus import common_focus
from ..scene.gravity import is_pitch_known, typical_roll, up_direction
from ..splats import STREAMED_SOG
from ..splats.arrays import LARGEST_SCALE, similarity
from .cameras.scene_cameras import middle_index, split_or_all, training_cameras

if TYPE_CHECKING:
    from ..runs.run import RenderableScene

log = logging.getLogger(__name__)
AXES = ("upright", "scene")
Y_DOWN_SUFFIXES = (".ply", ".sog", ".spz")
_WORST_ROLL = math.radians(12)  # Median roll about the common up above which the cameras are said to have none


@dataclass(frozen=True)
class WorldTransform:
    """A similarity: y = scale * rotation @ x + translation, from a scene's coordinates to a file's."""

    rotation: np.ndarray  # [3, 3] float64, proper
    translation: np.ndarray  # [3] float64
    scale: float = 1.0  # Positive factor; meters for each unit of the scene if it was set, else 1

    @staticmethod
    def identity() -> "WorldTransform":
        """Return the transform that changes nothing."""
        return WorldTransform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: Any) -> "WorldTransform":
        """Return the transform of a 4 x 4 matrix that acts on column vectors; raise ValueError for another kind."""
        values = similarity(matrix)
        scale = float(np.cbrt(np.linalg.det(values[:3, :3])))
        return WorldTransform(values[:3, :3] / scale, values[:3, 3], scale)

    @property
    def matrix(self) -> np.ndarray:
        """[4, 4] float64 that acts on column vectors."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = self.scale * self.rotation, self.translation
        return result

    @property
    def is_identity(self) -> bool:
        """True if nothing changes."""
        return bool(np.array_equal(self.matrix, np.eye(4)))

    def inverse(self) -> "WorldTransform":
        """Return the transform back to the scene's coordinates."""
        rotation = self.rotation.T
        return WorldTransform(rotation, -rotation @ self.translation / self.scale, 1 / self.scale)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform points [..., 3]."""
        return self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.translation

    def camera(self, camera: Camera) -> Camera:
        """Transform a camera; what it sees stays."""
        if self.is_identity:
            return camera  # To the last bit
        pose = np.eye(4)
        pose[:3, :3] = camera.world_to_camera[:3, :3] @ self.rotation.T
        pose[:3, 3] = -pose[:3, :3] @ self.points(camera.position)
        return replace(camera, world_to_camera=pose)


def world_transform(
    run: "RenderableScene",
    axes: str = "upright",
    *,
    up: str | Sequence[float] | None = None,
    scale: float | None = None,
) -> WorldTransform:
    """Return the transform from a scene's coordinates to those of its files.

    upright: +Y is up, and the origin is the point that most cameras look at, or else their middle. The camera in the
    middle looks along +Z, as far as that is horizontal. Gaussians from a file that states its transform are upright
    already and stay as they are.

    Args:
        run: From load_run, train or load_splats.
        axes: "upright", or "scene" for the photos' coordinates.
        up: The up direction in the scene's coordinates, as "x,y,z", three numbers, or an axis such as "-y"; None
            for the one kept with the run, or else gravity as photos and cameras show it.
        scale: Meters for each unit of the scene; None for the one kept with the run, that of the photos' GPS, or 1.

    Raises:
        SehdrError: For values out of range, or options that exclude each other.
    """
    if axes not in AXES:
        raise SehdrError(f"axes {axes!r} is not one of {', '.join(AXES)}")
    run = run.reference or run  # Of merged scenes the first one
    orientation = read_orientation(run)
    if axes == "scene":
        if up is not None:
            raise SehdrError("--up turns the scene upright, and --axes scene leaves it as it is; leave one of them out")
        factor, to_photos = _checked_scale(scale), photos_to_scene(run).inverse()
        return WorldTransform(to_photos.rotation, factor * to_photos.translation, factor * to_photos.scale)
    by_gps = None if run.up is None else run.up.unit
    factor = _checked_scale(next((each for each in (scale, orientation.scale, by_gps) if each is not None), None))
    direction = _known_up(run, up, orientation)
    cameras = split_or_all(run, "train")
    if direction is None and (run.world_matrix is not None or not cameras):
        # Turned about the axis of view, so that what is ahead stays ahead.
        rotation = np.diag([-1.0, -1.0, 1.0]) if is_y_down(run.path) else np.eye(3)
        return WorldTransform(rotation, np.zeros(3), factor)
    if direction is None:
        direction = up_direction(cameras) if run.up is None else run.up.direction
        roll = typical_roll(cameras, direction)
        if roll > _WORST_ROLL:
            text = "the photos share no up direction (typically %.0f degrees off); set --up x,y,z, or --axes scene"
            log.warning(text, math.degrees(roll))
        elif not is_pitch_known(cameras, direction):
            log.info(
                "the photos all look one way, so their mean tilt counts as level; if that is not so, set --up, or pick "
                "three points of the floor in the viewer"
            )
    rotation, origin = _rotation(direction, cameras[middle_index(cameras)] if cameras else None), np.zeros(3)
    if cameras:
        focus = common_focus(cameras)
        origin = np.mean([camera.position for camera in cameras], axis=0) if focus is None else focus
    return WorldTransform(rotation, -factor * (rotation @ origin), factor)


def photos_to_scene(run: "RenderableScene") -> WorldTransform:
    """Return the transform from the photos' coordinates to the scene's, which a file of Gaussians may state."""
    return WorldTransform.identity() if run.world_matrix is None else WorldTransform.from_matrix(run.world_matrix)


def photos_to_file(run: "RenderableScene", transform: WorldTransform) -> np.ndarray:
    """Return the [4, 4] that a file states: from the photos' coordinates to its own, which `transform` leads to."""
    return transform.matrix if run.world_matrix is None else transform.matrix @ run.world_matrix


def scene_up(run: "RenderableScene", up: str | Sequence[float] | None = None) -> np.ndarray:
    """Return the up direction [3] in the scene's coordinates, as world_transform takes it; log nothing."""
    run = run.reference or run
    direction = _known_up(run, up, read_orientation(run))
    if direction is None and run.world_matrix is None and (cameras := training_cameras(run)):
        direction = up_direction(cameras) if run.up is None else run.up.direction
    return world_transform(run).rotation[1] if direction is None else direction


def _known_up(
    run: "RenderableScene", up: str | Sequence[float] | None, orientation: "Orientation"
) -> np.ndarray | None:
    """Return the up direction that is stated, kept with a run or was found at its training; None if there is none."""
    if up is not None:
        return read_direction(up)
    if orientation.up is not None or run.up is None or run.up.source == "cameras":
        return orientation.up
    return run.up.direction


def is_y_down(path: Path | str) -> bool:
    """Return whether programs expect the Gaussians in a file of this suffix with -Y up.

    Viewers of 3D Gaussian Splatting turn PLY, SOG and SPZ over, as COLMAP's axes make photos' scenes have -Y up; glTF
    and OpenUSD define +Y.
    """
    return Path(path).suffix.lower() in Y_DOWN_SUFFIXES or Path(path).name.lower() == STREAMED_SOG


def file_transform(transform: WorldTransform, path: Path | str) -> WorldTransform:
    """Return a transform to upright coordinates, turned over for a file whose readers expect -Y up."""
    if not is_y_down(path):
        return transform
    turn = np.diag([-1.0, -1.0, 1.0])
    return WorldTransform(turn @ transform.rotation, turn @ transform.translation, transform.scale)


def read_direction(text: str | Sequence[float]) -> np.ndarray:
    """Return a unit vector from "x,y,z", three numbers, or an axis such as "y", "+z" or "-y"."""
    try:
        if isinstance(text, str) and text.strip().lower().lstrip("+-") in ("x", "y", "z"):
            name = text.strip().lower()
            values = np.eye(3)["xyz".index(name[-1])] * (-1 if name[0] == "-" else 1)
        else:
            values = np.array([float(v) for v in (text.split(",") if isinstance(text, str) else text)])
        length = np.linalg.norm(values)
        if values.shape == (3,) and np.isfinite(length) and length > 0:
            return values / length
    except (ValueError, TypeError, OverflowError):
        pass
    remedy = "write x,y,z in the scene's coordinates, or an axis such as -y"
    raise SehdrError(f"up {text!r:.90} is not a direction; {remedy}")


class Orientation(NamedTuple):
    """Up direction [3] in a scene's coordinates, and meters for each unit of it; None if not set."""

    up: np.ndarray | None = None
    scale: float | None = None


def read_orientation(run: "RenderableScene") -> Orientation:
    """Return the up direction and the scale that are kept with a run; neither during a training.

    Raises:
        InputError: If the file is damaged.
    """
    folder = getattr(run, "path", None)
    if folder is None or not (path := Path(folder) / ORIENTATION_FILE).is_file():
        return Orientation()
    values = read_json(path)
    try:
        up = None if values.get("up") is None else read_direction(values["up"])
        scale = None if values.get("scale") is None else _checked_scale(values["scale"])
    except (SehdrError, AttributeError) as error:
        raise InputError(path, f"cannot be used ({error})", "delete the file, or set up and scale again") from None
    return Orientation(up, scale)


def write_orientation(run: "RenderableScene", *, up: Sequence[float] | None = None, scale: float | None = None) -> Path:
    """Keep an up direction and a scale with a run, which all of its files then follow; return the file that holds them.

    Args:
        run: From load_run or train.
        up: Direction [3] in the scene's coordinates; None leaves what is kept.
        scale: Meters for each unit of the scene; None leaves what is kept.

    Raises:
        SehdrError: For a file of Gaussians, or a value that cannot be.
    """
    require_loaded("load_run", run)
    path = Path(run.path) / ORIENTATION_FILE
    if not path.parent.is_dir():
        raise SehdrError(f"{run.path}: is not a run; up and scale of a file of Gaussians are set by --up and --scale")
    before = read_orientation(run)
    direction = before.up if up is None else read_direction(up)
    values = {
        "up": None if direction is None else direction.tolist(),
        "scale": before.scale if scale is None else _checked_scale(scale),
    }
    write_json(path, values, internal=True)
    return path


def _checked_scale(scale: Any) -> float:
    if scale is None:
        return 1.0
    if not isinstance(scale, int | float) or not 1 / LARGEST_SCALE <= scale <= LARGEST_SCALE:
        raise SehdrError(f"scale {scale!r:.40} is not between 1e-6 and 1e6 meters for each unit of the scene")
    return float(scale)


def _rotation(up: np.ndarray, ahead: Camera | None) -> np.ndarray:
    """Return [3, 3] whose rows are the file's +X, +Y (up) and +Z (ahead) in the scene's coordinates."""
    forward = np.array([0.0, 0, 1]) if ahead is None else ahead.world_to_camera[2, :3]
    forward = forward - up * (forward @ up)
    if np.linalg.norm(forward) < 1e-3:  # It looks straight up or down.
        forward = np.linalg.svd(up[None])[2][1]
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(up, forward), up, forward])
