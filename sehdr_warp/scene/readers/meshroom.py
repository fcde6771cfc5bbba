"""Meshroom's and AliceVision's cameras.sfm (JSON): poses and lenses of all versions. Points are not read."""

from contextlib import suppress
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from ...errors import InputError
from ...files import read_json
from ...json_values import damage, json_list, json_object, number, numbers, text
from ..dataparser import DataparserOutputs, ImageRecord, pose_from_camera_to_world
from ..file_names import find_images, natural_key
from ..lens import Lens
from ..photos import unusable_notes
from .transforms import absent_note

_PLACES = ("*.sfm", "sfm*.json", "MeshroomCache/StructureFromMotion/*/cameras.sfm")
_LISTS = ("views", "path"), ("poses", "poseId"), ("intrinsics", "intrinsicId")
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
        version = tuple(int(part) for part in numbers(values, "version", -1))
        views, poses, lenses = (_by_name(values, *names) for names in _LISTS)
        transforms = {name: json_object(pose["pose"], "pose")["transform"] for name, pose in poses.items()}
    except (KeyError, ValueError, OverflowError) as error:
        raise InputError(path, f"is not a file of Meshroom with poses ({damage(error)})", _REMEDY) from None
    names = [name for name in sorted(views, key=natural_key) if str(views[name].get("poseId")) in transforms]
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
            pose = _pose(transforms[str(view["poseId"])], view, path, plain)
            # AliceVision reads pixels as they are stored, whatever their EXIF orientation says.
            records.append(ImageRecord(image.stem, image, lens, pose))
        except InputError as error:
            unusable.append(error)
    notes = [*unusable_notes(unusable, len(records) + len(unusable)), *absent_note(absent, len(records))]
    if unplaced := [PureWindowsPath(name).name for name in views if name not in images]:
        notes.append(f"{len(unplaced)} of {len(views)} photos have no pose in {path.name} and were left out")
    return DataparserOutputs("meshroom", tuple(records), notes=tuple(notes), mentioned=tuple(unplaced))


def _by_name(values: dict[str, Any], name: str, key: str) -> dict[str, dict[str, Any]]:
    """Return the objects of a list by one of their fields; raise ValueError or KeyError for what is not such a list."""
    objects = [json_object(each, f"one of {name}") for each in json_list(values[name], name)]
    return {text(each, key): each for each in objects}


def _pose(transform: Any, view: dict, path: Path, name: str) -> np.ndarray:
    """Return [4, 4] world_to_camera in OpenCV's axes; the file has its rotation column by column."""
    try:
        if view.get("rigId", "4294967295") != "4294967295":
            raise ValueError("cameras of rigs are not read")
        # The columns of a rotation are the rows of its inverse.
        inverse = numbers(json_object(transform, "transform"), "rotation", 3, 3)
        matrix = np.c_[inverse, numbers(transform, "center", 3)]
    except (KeyError, ValueError) as error:
        raise InputError(path, f"pose of {name!r:.90} cannot be used ({damage(error)})", _REMEDY) from None
    return pose_from_camera_to_world(matrix, path, name)


def _lens(values: dict, version: tuple[int, ...], path: Path, name: str) -> Lens:
    """Return a lens. Versions differ in the focal length, its aspect and the origin of the principal point."""
    try:
        width, height = int(number(values, "width")), int(number(values, "height"))
        if version < (1, 2, 2):
            one = not isinstance(values["pxFocalLength"], list)
            fx, fy = [number(values, "pxFocalLength")] * 2 if one else numbers(values, "pxFocalLength", 2).tolist()
        else:
            fx = number(values, "focalLength") / number(values, "sensorWidth") * width
            fy = fx * number(values, "pixelRatio", 1) ** (1 if version >= (1, 2, 5) else -1)
        cx, cy = numbers(values, "principalPoint", 2).tolist()
        if version >= (1, 2, 1):
            cx, cy = cx + width / 2, cy + height / 2
        kind = values["type"] if values["type"] != "pinhole" else values.get("distortionType", "none")
        bent = numbers(values, "distortionParams", -1).tolist() if values.get("distortionParams") else []
        k1, k2, k3, k4, k5 = [*bent, 0.0, 0.0, 0.0, 0.0, 0.0][:5]
    except (KeyError, ValueError, OverflowError, ZeroDivisionError) as error:
        raise InputError(path, f"lens of {name!r:.90} cannot be used ({damage(error)})", _REMEDY) from None
    if kind in ("fisheye4", "fisheye"):
        return Lens("OPENCV_FISHEYE", width, height, (fx, fy, cx, cy, k1, k2, k3, k4), path)
    if kind not in ("none", "radial1", "radialk1", "radial3", "radialk3", "brown"):
        remedy = "use radial3, brown or fisheye4, or export undistorted photos for COLMAP"
        raise InputError(path, f"lens of {name!r:.90} is of type {kind!r:.40}, which is not read", remedy)
    return Lens("FULL_OPENCV", width, height, (fx, fy, cx, cy, k1, k2, k4, k5, k3, 0.0, 0.0, 0.0), path)
