"""COLMAP's sparse models, binary and text, read with every count and name checked before it is trusted.

Formats: https://colmap.github.io/format.html. A count may not promise more records than the bytes left can hold,
names are terminated and at most 4096 bytes long, values are finite, quaternions are not zero.
"""

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import read_bytes, read_text
from .capture import pose_from_quaternion
from .lens import CAMERA_MODELS, PARAMETER_COUNTS, Lens

MAX_NAME_BYTES = 4096
_REMEDY = "export the model again with COLMAP"


@dataclass(frozen=True)
class ModelImage:
    """name: as stored, not yet trusted as a path; world_to_camera: [4, 4]."""

    name: str
    camera_id: int
    world_to_camera: np.ndarray


@dataclass(frozen=True)
class SparseModel:
    """cameras: by id; images: in the file's order; points: [P, 3] float64; colors: [P, 3] float32 in [0, 1]."""

    cameras: dict[int, Lens]
    images: tuple[ModelImage, ...]
    points: np.ndarray
    colors: np.ndarray


def find_model(folder: Path) -> Path | None:
    """The folder among sparse/0, sparse and colmap/sparse/0 that holds cameras and images, or None."""
    for name in ("sparse/0", "sparse", "colmap/sparse/0", "dense/sparse"):
        for suffix in (".bin", ".txt"):
            if (folder / name / f"cameras{suffix}").is_file():
                return folder / name
    return None


def read_model(folder: Path) -> SparseModel:
    """Read cameras, images and (where present) points3D from a folder, binary files before text files.

    Raises InputError where a file is missing, empty, damaged or truncated, or holds values that cannot be.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    cameras = (_cameras_binary if binary else _cameras_text)(folder / f"cameras{suffix}")
    images_path = folder / f"images{suffix}"
    images = (_images_binary if binary else _images_text)(images_path)
    for image in images:
        if image.camera_id not in cameras:
            raise InputError(
                images_path, f"image {image.name!r:.90} has camera {image.camera_id}, which is not listed", _REMEDY
            )
    points, colors = read_points(folder)
    return SparseModel(cameras, tuple(images), points, colors)


def read_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """[P, 3] float64 places and [P, 3] float32 colours in [0, 1] of points3D.bin, .txt or .ply; else none."""
    if (path := folder / "points3D.bin").is_file():
        return _points_binary(path)
    if (path := folder / "points3D.txt").is_file():
        return _points_text(path)
    for name in ("points3D.ply", "points3d.ply"):
        if (path := folder / name).is_file():
            return read_ply_points(path)
    return np.zeros((0, 3)), np.zeros((0, 3), np.float32)


def read_ply_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Places and colours of a PLY file's vertices; grey where it has no colours. InputError where it is damaged."""
    from plyfile import PlyData

    read_bytes(path)
    try:
        vertex = PlyData.read(str(path))["vertex"].data
        points = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
        if {"red", "green", "blue"} <= set(vertex.dtype.names):
            colors = np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1)
            colors = colors / 255 if np.issubdtype(colors.dtype, np.integer) else colors
        else:
            colors = np.full(points.shape, 0.5)
    # plyfile has no exception of its own for what damaged files do to it.
    except Exception as error:  # noqa: BLE001
        raise InputError(path, f"cannot be read as PLY points ({error!r:.120})", "export the points again") from None
    return _checked_points(points, np.clip(colors, 0, 1).astype(np.float32), path)


def _checked_points(points: np.ndarray, colors: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise InputError(path, f"point {int(np.argmax(bad))} is at {points[np.argmax(bad)].tolist()}", _REMEDY)
    return points, colors


class _Bytes:
    """A cursor over a file that never reads past its end."""

    def __init__(self, path: Path):
        self.path, self.data, self.position = path, read_bytes(path), 0

    def take(self, layout: struct.Struct) -> tuple:
        if self.position + layout.size > len(self.data):
            raise InputError(self.path, f"ends early, at byte {len(self.data)}", _REMEDY)
        values = layout.unpack_from(self.data, self.position)
        self.position += layout.size
        return values

    def count(self, smallest_record: int) -> int:
        """A 64-bit count of records of at least so many bytes each."""
        (count,) = self.take(_COUNT)
        left = len(self.data) - self.position
        if count * smallest_record > left:
            raise InputError(
                self.path, f"count {count} needs {count * smallest_record} bytes, but {left} are left", _REMEDY
            )
        return count

    def name(self) -> str:
        end = self.data.find(b"\0", self.position, self.position + MAX_NAME_BYTES + 1)
        if end < 0:
            raise InputError(
                self.path, f"image name at byte {self.position} has no end within {MAX_NAME_BYTES} bytes", _REMEDY
            )
        raw, self.position = self.data[self.position : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(self.path, f"image name {raw[:40]!r} is not UTF-8 text", "rename the image") from None

    def skip(self, size: int) -> None:
        self.position += size


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_OBSERVATION_BYTES = 24
_TRACK_ELEMENT_BYTES = 8


def _cameras_binary(path: Path) -> dict[int, Lens]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.count(_CAMERA.size + 3 * 8)):
        camera_id, model, width, height = file.take(_CAMERA)
        if model not in CAMERA_MODELS:
            raise InputError(path, f"camera {camera_id} has the unknown model {model}", "undistort with COLMAP first")
        name, count = CAMERA_MODELS[model]
        params = file.take(struct.Struct(f"<{count}d"))
        _add_camera(cameras, camera_id, Lens(name, width, height, params, path), path)
    return cameras


def _images_binary(path: Path) -> list[ModelImage]:
    file, images, names = _Bytes(path), [], set()
    for _ in range(file.count(_IMAGE.size + 1 + 8)):
        _, qw, qx, qy, qz, tx, ty, tz, camera_id = file.take(_IMAGE)
        name = file.name()
        file.skip(file.count(_OBSERVATION_BYTES) * _OBSERVATION_BYTES)
        images.append(_image(name, (qw, qx, qy, qz), (tx, ty, tz), camera_id, names, path))
    return images


def _points_binary(path: Path) -> tuple[np.ndarray, np.ndarray]:
    file = _Bytes(path)
    count = file.count(_POINT.size)
    points, colors = np.empty((count, 3)), np.empty((count, 3), np.float32)
    for i in range(count):
        _, x, y, z, red, green, blue, _, track = file.take(_POINT)
        if track * _TRACK_ELEMENT_BYTES > len(file.data) - file.position:
            raise InputError(path, f"track length {track} of point {i} goes past the end", _REMEDY)
        file.skip(track * _TRACK_ELEMENT_BYTES)
        points[i], colors[i] = (x, y, z), (red, green, blue)
    return _checked_points(points, colors / np.float32(255), path)


def _add_camera(cameras: dict[int, Lens], camera_id: int, lens: Lens, path: Path) -> None:
    if camera_id in cameras:
        raise InputError(path, f"camera {camera_id} is listed twice", _REMEDY)
    cameras[camera_id] = lens


def _image(name, quaternion, translation, camera_id, names: set, path: Path) -> ModelImage:
    if not name or len(name.encode("utf-8", "replace")) > MAX_NAME_BYTES:
        raise InputError(
            path, f"image name {name[:40]!r} is empty or longer than {MAX_NAME_BYTES} bytes", "rename the image"
        )
    if name in names:
        raise InputError(path, f"image {name!r:.90} is listed twice", _REMEDY)
    names.add(name)
    return ModelImage(name, camera_id, pose_from_quaternion(quaternion, translation, path, name))


def _numbered_lines(path: Path):
    return list(enumerate(read_text(path).splitlines(), start=1))


def _broken(path: Path, number: int, line: str, what: str) -> InputError:
    return InputError(path, f"line {number} is not {what}: {line[:60]!r}", _REMEDY)


def _cameras_text(path: Path) -> dict[int, Lens]:
    cameras = {}
    for number, line in _numbered_lines(path):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split()
        try:
            camera_id, model, width, height = int(fields[0]), fields[1], int(fields[2]), int(fields[3])
            params = tuple(float(value) for value in fields[4:])
        except (ValueError, IndexError):
            raise _broken(path, number, line, "a camera (id, model, width, height, parameters)") from None
        if model not in PARAMETER_COUNTS:
            raise InputError(
                path, f"line {number} has the unknown camera model {model!r:.40}", "undistort with COLMAP first"
            )
        _add_camera(cameras, camera_id, Lens(model, width, height, params, path), path)
    return cameras


def _images_text(path: Path) -> list[ModelImage]:
    lines = iter(_numbered_lines(path))
    images, names = [], set()
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split(maxsplit=9)
        try:
            values = [float(value) for value in fields[1:8]]
            camera_id, name = int(fields[8]), fields[9].strip()
        except (ValueError, IndexError):
            raise _broken(path, number, line, "an image (id, quaternion, translation, camera, name)") from None
        next(lines, None)  # the observations; an empty line, or none at the end of the file, where there are none
        images.append(_image(name, values[:4], values[4:], camera_id, names, path))
    return images


def _points_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    points, colors = [], []
    for number, line in _numbered_lines(path):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split(maxsplit=7)
        try:
            place = [float(value) for value in fields[1:4]]
            color = [int(value) for value in fields[4:7]]
        except ValueError:
            raise _broken(path, number, line, "a point (id, x, y, z, r, g, b, ...)") from None
        if len(color) != 3 or not all(0 <= value <= 255 for value in color) or not all(map(math.isfinite, place)):
            raise _broken(path, number, line, "a point with finite x, y, z and colours in 0..255")
        points.append(place)
        colors.append(color)
    colors = np.array(colors, np.float32).reshape(-1, 3) / np.float32(255)
    return np.array(points, np.float64).reshape(-1, 3), colors
