"""Reader of scans by apps of phones: a JSON file with ARKit's pose and lens for each photo.

3D Scanner App writes frame_00001.json beside frame_00001.jpg; Polycam's raw data has keyframes/cameras/1.json for
keyframes/images/1.jpg, and corrected_cameras/ and corrected_images/ after its own optimization.
"""

import itertools
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import InputError
from ...files import read_json
from ...json_values import damage, number, numbers
from ..dataparser import DataparserOutputs, ImageRecord
from ..file_names import find_image, list_images, natural_key
from ..images.ldr_files import LDR_SUFFIXES, PHOTO_SUFFIXES
from ..lens import Lens
from ..photos import FEWEST_PHOTOS, photo_sizes, unusable_notes
from .photo_copies import find_maps, maps_note
from .transforms import absent_note, pose_from_opengl

_PLACES = tuple(
    (f"{above}{kind}images", f"{above}{kind}cameras") for above in ("keyframes/", "") for kind in ("corrected_", "")
)
_POLYCAM = [f"t_{row}{column}" for row in range(3) for column in range(4)]
_MARKS = (b'"cameraPoseARFrame"', b'"t_00"')
_MOST_READ = 20  # Files whose content is looked at
_REMEDY = "export the scan again, or give a folder with the photos alone"


class ScanFolders(NamedTuple):
    """Folders of the photos of a scan and of the JSON files with their poses."""

    photos: Path
    poses: Path


def find_scan(folder: Path) -> ScanFolders | None:
    """Return the folders of photos and of their poses, None if fewer photos than a training needs have one."""
    for images, cameras in (*_PLACES, (".", ".")):
        photos, poses = folder / images, folder / cameras
        if photos.is_dir() and poses.is_dir():
            files = (poses / f"{photo.stem}.json" for photo in list_images(photos, PHOTO_SUFFIXES))
            present = itertools.islice((file for file in files if file.is_file()), _MOST_READ)
            if sum(map(_states_pose, present)) >= FEWEST_PHOTOS:
                return ScanFolders(photos, poses)
    return None


def read_scan(folder: Path) -> DataparserOutputs:
    """Parse a scan: a record for each photo that has a pose. Poses are camera-to-world in OpenGL's axes."""
    places = find_scan(folder)
    assert places is not None
    photos, poses = places
    records, absent, unusable = [], [], []
    for file in filter(_states_pose, sorted(poses.glob("*.json"), key=lambda file: natural_key(file.name))):
        if (image := find_image(photos, f"{file.stem}.jpg", file)) is None:
            absent.append(file.stem)
            continue
        try:
            records.append(_record(image, file))
        except InputError as error:
            unusable.append(error)
    maps = find_maps(list_images(photos, LDR_SUFFIXES))
    notes = [*unusable_notes(unusable, len(records) + len(unusable)), *absent_note(absent, len(records))]
    notes += [
        *maps_note(maps),
        "poses are the app's: to find cameras by structure from motion, give a folder with the photos alone",
    ]
    mentioned = tuple(picture.name for picture in maps)
    return DataparserOutputs("arkit", tuple(records), notes=tuple(notes), mentioned=mentioned)


def _states_pose(file: Path) -> bool:
    """Return whether a file can be read and states a pose; a pipe would block."""
    head = b""
    if file.is_file():
        with suppress(OSError), file.open("rb") as opened:
            head = opened.read(1 << 16)
    return any(mark in head for mark in _MARKS)


def _record(image: Path, file: Path) -> ImageRecord:
    """Return a photo with its camera; raise InputError if the file states no usable one."""
    values = read_json(file)
    try:
        if "t_00" in values:
            matrix = np.reshape([number(values, key) for key in _POLYCAM], (3, 4))
            params = tuple(number(values, key) for key in ("fx", "fy", "cx", "cy"))
            width, height = int(number(values, "width")), int(number(values, "height"))
        else:
            matrix = numbers(values, "cameraPoseARFrame", -1, 4)
            (fx, _, cx), (_, fy, cy), *_ = numbers(values, "intrinsics", -1, 3).tolist()
            params, (width, height) = (fx, fy, cx, cy), photo_sizes(image)[0]
    except (KeyError, ValueError, OverflowError) as error:
        raise InputError(file, f"states no usable pose and lens ({damage(error)})", _REMEDY) from None
    pose = pose_from_opengl(matrix, file, image.name)
    return ImageRecord(image.stem, image, Lens("PINHOLE", width, height, params, file), pose)
