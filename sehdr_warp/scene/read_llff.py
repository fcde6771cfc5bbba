"""LLFF's pose files: `poses_bounds_exps.npy` of HDR-NeRF's real sets and plain `poses_bounds.npy`."""

import io
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import read_bytes
from .capture import Capture, Shot, pose_from_camera_to_world
from .colmap_model import find_model
from .images import LDR_SUFFIXES
from .lens import Lens
from .names import list_images, view_and_exposure
from .read_colmap import poses_by_view

_REMEDY = "export the poses again with LLFF's imgs2poses"


def read_hdr_nerf_real(folder: Path) -> Capture:
    """HDR-NeRF's real layout: `input_images/<view>_<k>.jpg`, `poses_bounds_exps.npy` [n, 18], seconds last.

    Rows follow the sorted file names. Where `sparse/0` lies beside (HDR-GS's edition of these sets), its cameras,
    poses and points are taken, since every exposure of a view then has one pose.
    """
    path = folder / "poses_bounds_exps.npy"
    rows = _rows(path, 18)
    images = _images(folder / "input_images", path, len(rows))
    points, poses = {}, None
    if find_model(folder) is not None:
        model, poses = poses_by_view(folder)
        points = {"points": model.points, "point_colors": model.colors}
    shots, absent = [], set()
    for row, image in zip(rows, images, strict=True):
        view, key = view_and_exposure(image.stem)
        if poses is not None and view not in poses:
            absent.add(view)
            continue
        lens, pose = _camera(row, path, image.name) if poses is None else poses[view]
        shots.append(Shot(view, image, lens, pose, exposure_key=key, exposure_time=float(row[17])))
    notes = (f"{len(absent)} views are not in the sparse model and were left out",) if absent else ()
    return Capture("hdr-nerf-real", tuple(shots), holdout=(2, 1), notes=notes, **points)


def read_llff(folder: Path) -> Capture:
    """`images/` with `poses_bounds.npy` [n, 17], rows in the order of the sorted file names."""
    path = folder / "poses_bounds.npy"
    rows = _rows(path, 17)
    images = _images(folder / "images", path, len(rows))
    shots = (Shot(image.stem, image, *_camera(row, path, image.name)) for row, image in zip(rows, images, strict=True))
    return Capture("llff", tuple(shots), holdout=(8, 0))


def _rows(path: Path, width: int) -> np.ndarray:
    """[n, width] float64; the shape is checked against the file's size before any memory is asked for."""
    data = io.BytesIO(read_bytes(path, 1 << 28))
    try:
        version = np.lib.format.read_magic(data)
        reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = reader(data)
        left = data.getbuffer().nbytes - data.tell()
        if dtype.kind != "f" or len(shape) != 2 or shape[1] != width or shape[0] * width * dtype.itemsize != left:
            raise ValueError(f"shape {shape} of {dtype}, {left} bytes")
        data.seek(0)
        return np.lib.format.read_array(data, allow_pickle=False).astype(np.float64)
    # NumPy parses the header as Python; what that raises for damaged ones is open-ended.
    except Exception as error:  # noqa: BLE001
        raise InputError(path, f"is not an [n, {width}] array of numbers ({str(error)[:80]})", _REMEDY) from None


def _images(folder: Path, path: Path, count: int) -> list[Path]:
    if not folder.is_dir():
        raise InputError(folder, "folder not found", "copy the whole set")
    images = sorted(list_images(folder, LDR_SUFFIXES), key=lambda file: file.name)
    if len(images) != count:
        raise InputError(path, f"has {count} rows for {len(images)} images in {folder.name}/", "copy the whole set")
    return images


def _camera(row: np.ndarray, path: Path, name: str) -> tuple[Lens, np.ndarray]:
    """Columns of the 3 x 5 matrix: down, right, backwards, position, (height, width, focal length)."""
    matrix = row[:15].reshape(3, 5)
    if not np.isfinite(matrix).all():
        raise InputError(path, f"pose of {name!r:.90} is not finite", _REMEDY)
    height, width, focal = (float(value) for value in matrix[:, 4])
    if not (1 <= width <= 1 << 16 and 1 <= height <= 1 << 16):
        raise InputError(path, f"image size of {name!r:.90} is {width:g} x {height:g}", _REMEDY)
    lens = Lens("SIMPLE_PINHOLE", round(width), round(height), (focal, width / 2, height / 2), path)
    camera_to_world = np.stack([matrix[:, 1], matrix[:, 0], -matrix[:, 2], matrix[:, 3]], axis=1)
    return lens, pose_from_camera_to_world(camera_to_world, path, name)
