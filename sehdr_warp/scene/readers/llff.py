"""Reader of LLFF's layout: poses_bounds.npy, whose rows are in the order of the photos' names."""

from pathlib import Path

import numpy as np

from ...errors import InputError
from ...files import read_bytes
from ..dataparser import DataparserOutputs, ImageRecord, pose_from_camera_to_world
from ..file_names import image_folder, list_images
from ..images.ldr_files import LDR_SUFFIXES
from ..lens import Lens

_POSES_REMEDY = "export the poses again with LLFF's imgs2poses"


def read_llff(folder: Path) -> DataparserOutputs:
    """Parse LLFF's layout: `images/` and `poses_bounds.npy` [n, 17], rows in the order of the sorted file names."""
    path = folder / "poses_bounds.npy"
    rows = pose_rows(path, 17)
    images = images_of_rows(image_folder(folder) or folder / "images", path, len(rows))
    records = (
        ImageRecord(image.stem, image, *camera_of_row(row, path, image.name))
        for row, image in zip(rows, images, strict=True)
    )
    return DataparserOutputs("llff", tuple(records), holdout=(8, 0))


def pose_rows(path: Path, width: int) -> np.ndarray:
    """Read an array [n, width] as float64, mapped so that a false header cannot allocate more than the file has."""
    read_bytes(path, 1 << 28)
    try:
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
        if rows.dtype.kind != "f" or rows.ndim != 2 or rows.shape[1] != width:
            raise ValueError(f"shape {rows.shape} of {rows.dtype}")
        return np.array(rows, np.float64)
    # NumPy parses the header as Python, which raises any kind of exception for a damaged one.
    except Exception as error:  # noqa: BLE001
        raise InputError(path, f"is not an [n, {width}] array of numbers ({error!s:.80})", _POSES_REMEDY) from None


def images_of_rows(folder: Path, path: Path, count: int) -> list[Path]:
    """List the photos of a folder by name; raise InputError if the file does not have one row for each."""
    if not folder.is_dir():
        raise InputError(folder, "folder not found", "copy the whole set")
    images = sorted(list_images(folder, LDR_SUFFIXES), key=lambda file: file.name)
    if len(images) != count:
        raise InputError(path, f"has {count} rows for {len(images)} images in {folder.name}/", "copy the whole set")
    return images


def camera_of_row(row: np.ndarray, path: Path, name: str) -> tuple[Lens, np.ndarray]:
    """Return lens and pose from the 3 x 5 matrix of columns down, right, back, position, (height, width, focal)."""
    matrix = row[:15].reshape(3, 5)
    if not np.isfinite(matrix).all():
        raise InputError(path, f"pose of {name!r:.90} is not finite", _POSES_REMEDY)
    height, width, focal = (float(value) for value in matrix[:, 4])
    if not (1 <= width <= 1 << 16 and 1 <= height <= 1 << 16):
        raise InputError(path, f"image size of {name!r:.90} is {width:g} x {height:g}", _POSES_REMEDY)
    lens = Lens("SIMPLE_PINHOLE", round(width), round(height), (focal, width / 2, height / 2), path)
    camera_to_world = np.stack([matrix[:, 1], matrix[:, 0], -matrix[:, 2], matrix[:, 3]], axis=1)
    return lens, pose_from_camera_to_world(camera_to_world, path, name)
