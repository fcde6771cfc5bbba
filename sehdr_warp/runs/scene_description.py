"""Description of a scene in scene.json, and whether a run is used with the scene that its training began with.

Photos are described by signatures: the mean of the codes in a grid of GRID x GRID cells, of 8 bits each. It survives
another decoder, whose codes may differ by one, and changes with a photo that was edited, exchanged or developed anew.
That of a masked photo has a second part, of the mask.
"""

import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..json_values import numbers
from ..scene import Camera, Scene, View
from ..scene.photo_names import photo_labels
from ..subsets import first_names
from .values import FORMAT

log = logging.getLogger(__name__)
GRID = 8
_MOST_ROWS = 32  # Rows that are read of each row of cells; more would take longer for large photos and find little more
SFM_LAYOUTS = "photos", "video"  # Layouts of sets whose cameras structure from motion finds
# Cameras that differ less than this count as the same: 0.25 degrees, and parts of the cameras' radius and focal length.
_LEAST_COSINE, _MOST_MOVED, _MOST_ZOOMED = 0.99999, 0.01, 0.005
_ROUNDING = 1e-12  # Difference of poses, of positions in parts of the largest coordinate
_SAME_POSE = 0.02  # Of its largest number: difference that structure from motion leaves in a pose
_TOLERANCE = 2  # Codes of 255 that a cell may differ by: decoders differ by one, and the mean is rounded


def describe_scene(scene: Scene) -> dict:
    """Return what scene.json holds."""
    sources = [view.source or Path(view.name) for view in scene.views]
    views = [
        {name: getattr(view, name) for name in ("name", "split", "exposure_time")}
        | {
            "camera": view.camera.to_dict(),
            "has_hdr": view.hdr is not None,
            "photo": photo_signature(view.codes, view.mask),
        }
        | (_lens_values(view, label) if scene.format in SFM_LAYOUTS else {})
        for view, label in zip(scene.views, photo_labels(sources), strict=True)
    ]
    facts = {"exposure_times_known": scene.exposure_times_known, "notes": list(scene.notes)}
    return {"format": FORMAT, "name": scene.name, "layout": scene.format, **facts, "views": views}


def warn_of_other_cameras(run: Any, scene: Scene) -> None:
    """Log a warning if no view of a scene has the camera that the run has for its name: the world may be another."""
    poses = {entry.name: entry.camera.world_to_camera for entry in run.cameras}
    pairs = [(poses[view.name], view.camera.world_to_camera) for view in scene.views if view.name in poses]
    if poses and not any(np.allclose(*pair, rtol=0, atol=_SAME_POSE * max(1, np.abs(pair[0]).max())) for pair in pairs):
        problem = "no camera is that of the run's view of its name, so the scene may be another one than the run's"
        log.warning("%s: %s; load the photos that the run was trained on", scene.name, problem)


def _lens_values(view: View, label: str) -> dict:
    """Return photo_labels() and lens of a photo, with which it is read again without structure from motion."""
    if view.lens is None or view.source is None:
        return {}
    lens = {name: getattr(view.lens, name) for name in ("model", "width", "height", "params")}
    return {"lens": lens | {"file": label}}


class SceneDifference(NamedTuple):
    """Difference of two scenes."""

    what: str  # "layout", "views", "splits", "exposure times", "cameras", or the names of photos
    photos: bool  # Whether the pictures themselves differ


def scene_difference(saved: dict, current: dict) -> SceneDifference | None:
    """Return what differs between two descriptions of describe_scene(); None if they are of the same scene.

    Focal lengths that structure from motion found are not compared: in_world_of_run() does, with a tolerance.
    """
    saved, current = (json.loads(json.dumps(description)) for description in (saved, current))
    photos, current_photos = _split_photos(saved), _split_photos(current)
    if saved.get("layout") != current["layout"]:
        return SceneDifference("layout", False)
    if current["layout"] in SFM_LAYOUTS:
        for view in (*saved["views"], *current["views"]):
            for name in ("fx", "fy", "cx", "cy"):
                view["camera"].pop(name, None)
    for old, new in zip(saved["views"], current["views"], strict=False):
        if _are_one_camera(old["camera"], new["camera"]):
            new["camera"] = old["camera"]
    if saved["views"] != current["views"]:
        return SceneDifference(_differing_part(saved["views"], current["views"]), False)
    if changed := changed_photos(photos, current_photos):
        return SceneDifference(f"{changed[0]} and {len(changed) - 1} more" if len(changed) > 1 else changed[0], True)
    return None


def _are_one_camera(one: dict, other: dict) -> bool:
    """Return whether descriptions of cameras differ by rounding alone, as processors invert matrices."""
    rests = [{name: value for name, value in camera.items() if name != "world_to_camera"} for camera in (one, other)]
    try:
        old, new = (numbers(camera, "world_to_camera", 4, 4) for camera in (one, other))
    except (KeyError, ValueError):  # A damaged run
        return False
    near = np.abs(old - new) <= _ROUNDING * np.maximum(1, np.abs(old[:3, 3]).max() * (np.arange(4) == 3))
    return rests[0] == rests[1] and bool(near.all())


def _differing_part(saved: list[dict], current: list[dict]) -> str:
    """Return in what views of the same names differ, or "views" if these differ or something else does."""
    parts = {"camera": "cameras", "split": "splits", "exposure_time": "exposure times"}
    if [view["name"] for view in saved] == [view["name"] for view in current]:
        for part, text in parts.items():
            if any(one.get(part) != two[part] for one, two in zip(saved, current, strict=True)):
                return text
    return "views"


def _split_photos(description: dict) -> dict[str, str]:
    """Take the photos' signatures out of a description of a scene, and return them by the views' names.

    Lenses are taken out, too, because cameras tell of them.
    """
    for view in description["views"]:
        view.pop("lens", None)
    return {view["name"]: view.pop("photo") for view in description["views"]}


def photo_signature(codes: np.ndarray, mask: np.ndarray | None = None) -> str:
    """Return hexadecimal digits of codes [H, W, 3], uint8 or uint16, and of a mask [H, W] in [0, 1]."""
    if mask is None:
        return _means(codes)
    return f"{_means(codes)}/{_means(np.rint(mask * np.float32(255)).astype(np.uint8)[..., None])}"


def _means(codes: np.ndarray) -> str:
    height, width = codes.shape[:2]
    means = np.zeros((GRID, GRID))
    columns = [slice(*edge) for edge in _edges(width)]
    for row, (top, bottom) in enumerate(_edges(height)):
        band = np.asarray(codes[top : bottom : max(1, (bottom - top) // _MOST_ROWS)])
        means[row] = [band[:, part].mean() for part in columns]
    return np.rint(means * (255 / np.iinfo(codes.dtype).max)).astype(np.uint8).tobytes().hex()


def changed_photos(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the names of photos whose signatures differ; a name without a signature on either side does not count."""
    return [name for name in before if name in now and _differ(before[name], now[name])]


def _edges(length: int) -> list[tuple[int, int]]:
    """Return first and last pixel of each of GRID cells, which overlap if there are fewer pixels than cells."""
    starts = [index * length // GRID for index in range(GRID)]
    return [(start, max(start + 1, (index + 1) * length // GRID)) for index, start in enumerate(starts)]


def _differ(first: str, second: str) -> bool:
    """Return whether signatures have other parts, or cells that differ by more than _TOLERANCE."""
    try:
        one, other = ([np.frombuffer(bytes.fromhex(part), np.uint8) for part in s.split("/")] for s in (first, second))
    except ValueError:
        return True
    if [cells.shape for cells in one] != [cells.shape for cells in other]:
        return True
    return any((np.abs(a.astype(int) - b) > _TOLERANCE).any() for a, b in zip(one, other, strict=True))


def in_world_of_run(
    scene: Scene, cameras: Mapping[str, Camera], unit: float, run: Path | str, place: Path | str
) -> Scene:
    """Return a scene with the poses of a run's cameras, by the views' names; other views and points in the same world.

    Poses that structure from motion finds anew are turned, moved and scaled as a whole.

    Args:
        scene: The scene, as it was loaded.
        cameras: Cameras of the run, in scene coordinates.
        unit: Length of the run's normalized coordinates, in those of the scene.
        run: Folder of the run, to name in the error.
        place: Folder of the photos, to name in the error.

    Raises:
        InputError: If cameras differ otherwise from those of the run.
    """
    views = [view for view in scene.views if view.name in cameras]
    pairs = [(view.camera, cameras[view.name]) for view in views]
    zooms = np.array([new.fx / new.width * old.width / old.fx for new, old in pairs])
    unlike = np.abs(zooms - 1) > _MOST_ZOOMED
    is_same_world = all(np.array_equal(new.world_to_camera, old.world_to_camera) for new, old in pairs)
    if is_same_world and not unlike.any():
        return scene
    turns = np.stack([old.world_to_camera[:3, :3].T @ new.world_to_camera[:3, :3] for new, old in pairs])
    u, _, vt = np.linalg.svd(turns.sum(0))
    turn = u @ vt
    cosines = (np.einsum("nij,ij->n", turns, turn) - 1) / 2
    positions, targets = np.stack([(turn @ new.position, old.position) for new, old in pairs], axis=1)
    spread = np.linalg.norm(positions - positions.mean(0))
    scale = np.linalg.norm(targets - targets.mean(0)) / spread if spread else 1.0
    shift = targets.mean(0) - scale * positions.mean(0)
    distances = np.linalg.norm(scale * positions + shift - targets, axis=1) / unit
    unlike |= (cosines < _LEAST_COSINE) | (distances > _MOST_MOVED)
    if unlike.any():
        problem = f"{unlike.sum()} of {len(views)} photos have other cameras than {run} was trained with"
        remedy = "use the photos, cameras and --max-size of then, or train again"
        names = first_names([view.name for view, is_other in zip(views, unlike, strict=True) if is_other])
        raise InputError(place, f"{problem}: {names}", remedy)

    def with_pose(view: View) -> View:
        if view.name in cameras:
            pose = cameras[view.name].world_to_camera
        else:
            pose = view.camera.world_to_camera.copy()
            pose[:3, :3] = pose[:3, :3] @ turn.T
            pose[:3, 3] = -pose[:3, :3] @ (scale * turn @ view.camera.position + shift)
        return replace(view, camera=replace(view.camera, world_to_camera=pose))

    points = scale * scene.points @ turn.T + shift
    return replace(scene, views=tuple(map(with_pose, scene.views)), points=points)
