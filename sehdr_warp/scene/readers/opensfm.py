"""OpenSfM's reconstruction.json: cameras of all its projections, poses and points."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...files import read_text
from ...json_values import damage, json_list, json_object, number, numbers, text
from ...subsets import counted
from ..dataparser import NO_POINTS, DataparserOutputs, ImageRecord, PointCloud
from ..file_names import find_image, natural_key
from ..lens import Lens
from ..photos import unusable_notes

FILE = "reconstruction.json"
_PLACES = (FILE, f"opensfm/{FILE}")  # The second is OpenDroneMap's, whose images lie beside opensfm/
_REMEDY = "export it again with OpenSfM"
_SPHERES = ("spherical", "equirectangular")


def find_reconstruction(folder: Path) -> Path | None:
    """Return the file of reconstructions of a set, in the folder or its `opensfm/`, or None."""
    return next((folder / place for place in _PLACES if (folder / place).is_file()), None)


def read_opensfm(folder: Path) -> DataparserOutputs:
    """Parse a folder with `reconstruction.json` and `images/`: a record for each shot of the largest reconstruction.

    Raises:
        InputError: if the file is damaged, or none of its images is there.
    """
    path = find_reconstruction(folder) or folder / FILE
    images = next(
        (place / "images" for place in (path.parent, folder) if (place / "images").is_dir()), folder / "images"
    )
    try:
        models = json_list(json.loads(read_text(path)), "it")
        if models == []:
            raise InputError(path, "holds no reconstruction", "reconstruct again: OpenSfM placed no image")
        models = [json_object(each, f"reconstruction {place}") for place, each in enumerate(models)]
        model = max(models, key=lambda each: len(json_object(each["shots"], "shots")))
        shots, cameras = model["shots"], json_object(model["cameras"], "cameras")
    except (ValueError, RecursionError, KeyError) as error:
        raise InputError(path, f"is not a list of reconstructions ({damage(error)})", _REMEDY) from None
    lenses = {name: _lens(values, path, name) for name, values in cameras.items()}
    records, absent, unusable = [], [], []
    for name in sorted(shots, key=natural_key):
        image = find_image(images, name, path)
        if image is None:
            absent.append(name)
            continue
        camera = shots[name].get("camera") if isinstance(shots[name], dict) else None
        lens = lenses.get(camera) if isinstance(camera, str) else None
        if lens is None:
            raise InputError(path, f"shot {name!r:.90} has no camera of the file", _REMEDY)
        try:
            # OpenSfM reads pixels as they are stored, whatever their EXIF orientation says.
            records.append(ImageRecord(image.stem, image, lens, _pose(shots[name], path, name)))
        except InputError as error:
            unusable.append(error)
    notes = unusable_notes(unusable, len(records) + len(unusable))
    if not records:
        raise InputError(images, f"none of the {len(shots)} images of {FILE} is here", "copy the whole set")
    if absent:
        count = counted(len(absent), f"image of {FILE} is missing and was", f"images of {FILE} are missing and were")
        notes.append(f"{count} left out: {absent[0]!r:.90}{' ...' * (len(absent) > 1)}")
    if len(models) > 1:
        rest = sum(len(each["shots"]) for each in models) - len(shots)
        notes.append(
            f"{FILE} holds {len(models)} reconstructions: the largest is used, {rest} images of others are not"
        )
    return DataparserOutputs("opensfm", tuple(records), cloud=_points(model, path), notes=tuple(notes))


def _pose(shot: dict, path: Path, name: str) -> np.ndarray:
    """Return [4, 4] world_to_camera of a shot's rotation vector and translation."""
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    try:
        turn, move = (numbers(shot, key, 3) for key in ("rotation", "translation"))
        if not (np.isfinite(turn).all() and np.isfinite(move).all()):
            raise ValueError("not finite")
    except (KeyError, ValueError) as error:
        raise InputError(path, f"pose of {name!r:.90} cannot be used ({damage(error)})", _REMEDY) from None
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), move
    return pose


def _lens(values: Any, path: Path, name: str) -> Lens:
    """Return a camera's lens. OpenSfM's lengths are parts of the longer side, its center is the picture's."""
    try:
        values = json_object(values, "it")
        kind = text(values, "projection_type").lower()
        width, height = int(number(values, "width")), int(number(values, "height"))
        side = max(width, height)
        focal = number(values, "focal", number(values, "focal_x", 0.0))
        fx, fy = (number(values, key, focal) * side for key in ("focal_x", "focal_y"))
        cx, cy = (middle / 2 + number(values, key, 0.0) * side for middle, key in ((width, "c_x"), (height, "c_y")))
        k1, k2, k3, k4, p1, p2 = (number(values, key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    except (KeyError, ValueError, OverflowError) as error:
        raise InputError(path, f"camera {name!r:.60} cannot be used ({damage(error)})", _REMEDY) from None
    lenses = {
        "perspective": ("RADIAL", (fx, cx, cy, k1, k2)),
        "simple_radial": ("OPENCV", (fx, fy, cx, cy, k1, 0.0, 0.0, 0.0)),
        "radial": ("OPENCV", (fx, fy, cx, cy, k1, k2, 0.0, 0.0)),
        "brown": ("FULL_OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)),
        "fisheye": ("RADIAL_FISHEYE", (fx, cx, cy, k1, k2)),
        "fisheye_opencv": ("OPENCV_FISHEYE", (fx, fy, cx, cy, k1, k2, k3, k4)),
    }
    lenses |= dict.fromkeys(_SPHERES, ("EQUIRECTANGULAR", (float(width), float(height))))
    if kind not in lenses:
        problem = f"camera {name!r:.60} has projection_type {kind!r:.40}, which is not supported"
        raise InputError(path, problem, f"use one of {', '.join(lenses)}")
    model, params = lenses[kind]
    return Lens(model, width, height, params, path)


def _points(model: dict, path: Path) -> PointCloud:
    points = model.get("points")
    if not points:
        return NO_POINTS
    try:
        listed = [json_object(point, f"point {place}") for place, point in json_object(points, "points").items()]
        positions = np.array([point["coordinates"] for point in listed], np.float64).reshape(-1, 3)
        colors = np.array([point.get("color", (128, 128, 128)) for point in listed], np.float64).reshape(-1, 3)
        if not (np.isfinite(positions).all() and np.isfinite(colors).all()):
            raise ValueError("not finite")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(path, f"its points cannot be used ({damage(error)})", _REMEDY) from None
    return PointCloud(positions, np.clip(colors / 255, 0, 1).astype(np.float32))
