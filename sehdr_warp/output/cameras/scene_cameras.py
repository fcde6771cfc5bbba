"""The cameras of a scene: which were trained on, where they stand and what they look at."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...errors import SehdrError, did_you_mean
from ...scene import Camera
from ...scene.camera_focus import camera_positions
from ...scene.file_names import view_names_of
from ...scene.gravity import up_direction
from ...subsets import first_names

if TYPE_CHECKING:
    from ...runs.run import RenderableScene
    from ...runs.run_folder import CameraEntry

_ROUND_GAP = np.radians(120)  # A gap in azimuth smaller than this means that the photos go round the scene


def training_cameras(run: "RenderableScene") -> list[Camera]:
    """Return the training cameras of a scene."""
    return [entry.camera for entry in run.cameras if entry.split == "train"]


def split_or_all(run: "RenderableScene", split: str) -> list[Camera]:
    """Return the cameras of a split, train or test, or all cameras of a scene without any of it."""
    return [entry.camera for entry in run.cameras if entry.split == split] or [entry.camera for entry in run.cameras]


def find_view(run: "RenderableScene", name: str) -> "CameraEntry":
    """Return the view of a name, or of the file name of its photo; raise SehdrError if the scene has none."""
    views = {entry.name: entry for entry in run.cameras}
    if not views:
        remedy = "give a run, or keep what `export --cameras` writes beside a file"
        raise SehdrError(f"{run.path}: has no cameras, and so no view {name!r}; {remedy}")
    name = str(name)
    names = [each for each in (name, *view_names_of(name)) if each in views]
    if not names:
        some = first_names(list(views), 5)
        hint = did_you_mean(name, views) or "; see scene.json of the run, or the cameras beside the file"
        raise SehdrError(f"view {name!r} is not one of the scene's ({some}){hint}")
    return views[names[0]]


def middle_index(cameras: Sequence[Camera]) -> int:
    """Return the index of the camera nearest to the median position."""
    positions = camera_positions(cameras)
    return int(np.argmin(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))


def surround(cameras: Sequence[Camera], focus: np.ndarray, up: np.ndarray | None = None) -> bool:
    """Return whether cameras stand all around a point, as seen from above."""
    up = up_direction(cameras) if up is None else up
    east = np.linalg.svd(up[None])[2][1]
    offsets = camera_positions(cameras) - focus
    return is_full_circle(np.arctan2(offsets @ np.cross(up, east), offsets @ east))


def is_full_circle(azimuths: np.ndarray) -> bool:
    """Return whether directions, in radians, go all around."""
    ordered = np.sort(azimuths)
    return bool(np.diff(ordered, append=ordered[0] + 2 * np.pi).max() < _ROUND_GAP)
