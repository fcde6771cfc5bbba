"""Meshroom's and AliceVision's cameras.sfm (JSON): poses and lenses of all versions. Points are not read."""

from contextlib import suppress
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from ...errors import InputError
from ...files import read_json
from ..dataparser import DataparserOutputs, ImageRecord, pose_from_camera_to_world
from ..file_names import find_images, natural_key
from ..lens import Lens
from ..photos import unusable_notes
from .transforms import absent_note

_PLACES = ("*.sfm", "sfm*.json", "MeshroomCache/StructureFromMotion/*/cameras.sfm")
_REMEDY = "compute the node StructureFromMotion again, or export for COLMAP"


def find_sfm(folder: Path) -> Path | None:
    """Return the newest file with Meshroom's poses, of the first place in a folder that holds one, or None."""
    for place in _PLACES:
        if files := [file for file in folder.glob(place) if _states_poses(file)]:
            return max(files, key=lambda file: (file.name == "cameras.sfm", file.stat().st_mtime, file.name))
    return None


def _states_poses(file: Path) -> bool:
    """Return whether a file can be read and has poses, which that of the node CameraInit lacks."""
    with suppress(OSError):
        data = file.read_bytes() if file.is_file() else b""
        return b'"intrinsicId"' in data and b'"poses"' in data
    return False


def read_meshroom(folder: Path) -> DataparserOutputs:
    """Parse Meshroom's file: a record for each view that has a pose.

    Raises:
        InputError: if the file is damaged, or none of its photos is there.
    """
    path = find_sfm(folder) or folder / "cameras.sfm"
    values = read_json(path)
    try:
        version = tuple(int(number) for number in values["version"])
        views = {str(view["path"]): dict(view) for view in values["views"]}
        poses = {str(pose["poseId"]): pose["pose"]["transform"] for pose in values["poses"]}
        lenses = {str(lens["intrinsicId"]): dict(lens) for lens in values["intrinsics"]}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(path, f"is not a file of Meshroom with poses ({error!r:.60})", _REMEDY) from None
    names = [name for name in sorted(views, key=natural_key) if str(views[name].get("poseId")) in poses]
    images = find_images(folder, names, path)
    if not any(images.values()):
        problem = f"none of the {len(names)} photos with a pose in {path.name} is here"
        raise InputError(folder, problem, "put them beside the file or into a folder of it")
    records, absent, unusable = [], [], []
    for name, image in images.items():
        view, plain = views[name], PureWindowsPath(name).name
        try:
            if image is None:
                absent.append(plain)
                continue
            lens = _lens(lenses.get(str(view.get("intrinsicId")), {}), version, path, plain)
            pose = _pose(poses[str(view["poseId"])], view, path, plain)
            # AliceVision reads pixels as they are stored, whatever their EXIF orientation says.
            records.append(ImageRecord(image.stem, image, lens, pose))
        except InputError as error:
            unusable.append(error)
    notes = [*unusable_notes(unusable, len(records) + len(unusable)), *absent_note(absent, len(records))]
    if unplaced := [PureWindowsPath(name).name for name in views if name not in images]:
        notes.append(f"{len(unplaced)} of {len(views)} photos have no pose in {path.name} and were left out")
    return DataparserOutputs("meshroom", tuple(records), notes=tuple(notes), mentioned=tuple(unplaced))


def _pose(transform: Any, view: dict, path: Path, name: str) -> np.ndarray:
    """Return [4, 4] world_to_camera in OpenCV's axes; the file has its rotation column by column."""
    try:
        if view.get("rigId", "4294967295") != "4294967295":
            raise ValueError("cameras of rigs are not read")
        # The columns of a rotation are the rows of its inverse.
        inverse = np.array(transform["rotation"], np.float64).reshape(3, 3)
        matrix = np.c_[inverse, np.array(transform["center"], np.float64).reshape(3)]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(path, f"pose of {name!r:.90} cannot be used ({error!s:.40})", _REMEDY) from None
    return pose_from_camera_to_world(matrix, path, name)


def _lens(values: dict, version: tuple[int, ...], path: Path, name: str) -> Lens:
    """Return a lens. Versions differ in the focal length, its aspect and the origin of the principal point."""
    try:
        width, height = int(values["width"]), int(values["height"])
        if version < (1, 2, 2):
            fx, fy = np.broadcast_to(np.array(values["pxFocalLength"], np.float64), 2).tolist()
        else:
            fx = float(values["focalLength"]) / float(values["sensorWidth"]) * width
            fy = fx * float(values.get("pixelRatio", 1)) ** (1 if version >= (1, 2, 5) else -1)
        cx, cy = (float(number) for number in values["principalPoint"])
        if version >= (1, 2, 1):
            cx, cy = cx + width / 2, cy + height / 2
        kind = values["type"] if values["type"] != "pinhole" else values.get("distortionType", "none")
        k1, k2, k3, k4, k5 = [*map(float, values.get("distortionParams") or ()), 0.0, 0.0, 0.0, 0.0, 0.0][:5]
    except (KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        raise InputError(path, f"lens of {name!r:.90} cannot be used ({error!r:.60})", _REMEDY) from None
    if kind in ("fisheye4", "fisheye"):
        return Lens("OPENCV_FISHEYE", width, height, (fx, fy, cx, cy, k1, k2, k3, k4), path)
    if kind not in ("none", "radial1", "radialk1", "radial3", "radialk3", "brown"):
        remedy = "use radial3, brown or fisheye4, or export undistorted photos for COLMAP"
        raise InputError(path, f"lens of {name!r:.90} is of type {kind!r:.40}, which is not read", remedy)
    return Lens("FULL_OPENCV", width, height, (fx, fy, cx, cy, k1, k2, k4, k5, k3, 0.0, 0.0, 0.0), path)
