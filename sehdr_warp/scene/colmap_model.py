"""COLMAP's sparse models, binary and text, read with every count and name checked before it is trusted.

Formats: https://colmap.github.io/format.html. A count may not promise more records than the bytes left can hold,
names are terminated and at most 4096 bytes long, values are finite, quaternions are not zero.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import read_bytes, read_text
from .capture import pose_from_quaternion
from .lens import CAMERA_MODELS, PARAMETER_COUNTS, Lens

MAX_NAME_BYTES = 4096
_REMEDY = "export the model again with COLMAP"
_UNDISTORT = "undistort with COLMAP first"
_COUNT, _CAMERA, _IMAGE, _POINT = (struct.Struct(layout) for layout in ("<Q", "<IiQQ", "<I7dI", "<Q3d3BdQ"))
_OBSERVATION_BYTES, _TRACK_ELEMENT_BYTES = 24, 8


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
    """The folder among sparse/0, sparse, colmap/sparse/0 and dense/sparse that holds cameras, or None."""
    places = (folder / name for name in ("sparse/0", "sparse", "colmap/sparse/0", "dense/sparse"))
    return next((p for p in places if any((p / f"cameras{end}").is_file() for end in (".bin", ".txt"))), None)


def read_model(folder: Path) -> SparseModel:
    """Read cameras, images and (where present) points3D from a folder, binary files before text files.

    Raises InputError where a file is missing, empty, damaged or truncated, or holds values that cannot be.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    paths = [folder / f"{name}{'.bin' if binary else '.txt'}" for name in ("cameras", "images")]
    cameras: dict[int, Lens] = {}
    for number, lens in (_cameras_binary if binary else _cameras_text)(paths[0]):
        if number in cameras:
            raise InputError(paths[0], f"camera {number} is listed twice", _REMEDY)
        cameras[number] = lens
    images: dict[str, ModelImage] = {}
    for values, number, name in (_images_binary if binary else _images_text)(paths[1]):
        if not name or len(name.encode("utf-8", "replace")) > MAX_NAME_BYTES:
            problem = f"image name {name[:40]!r} is empty or longer than {MAX_NAME_BYTES} bytes"
            raise InputError(paths[1], problem, "rename the image")
        if name in images:
            raise InputError(paths[1], f"image {name!r:.90} is listed twice", _REMEDY)
        if number not in cameras:
            raise InputError(paths[1], f"image {name!r:.90} has camera {number}, which is not listed", _REMEDY)
        images[name] = ModelImage(name, number, pose_from_quaternion(values[:4], values[4:], paths[1], name))
    return SparseModel(cameras, tuple(images.values()), *read_points(folder))


def read_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """[P, 3] float64 places and [P, 3] float32 colours in [0, 1] of points3D.bin, .txt or .ply; else none."""
    readers = {".bin": _points_binary, ".txt": _points_text, ".ply": read_ply_points}
    for name in ("points3D.bin", "points3D.txt", "points3D.ply", "points3d.ply"):
        if (path := folder / name).is_file():
            return readers[path.suffix](path)
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
    return _checked_points(points, np.clip(colors, 0, 1), path)


def _checked_points(points: np.ndarray, colors: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise InputError(path, f"point {int(np.argmax(bad))} is at {points[np.argmax(bad)].tolist()}", _REMEDY)
    return points, colors.astype(np.float32)


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

    def count(self, smallest: int) -> int:
        """A 64-bit count of records of at least so many bytes each."""
        (count,) = self.take(_COUNT)
        left = len(self.data) - self.position
        if count * smallest > left:
            raise InputError(self.path, f"count {count} needs {count * smallest} bytes, but {left} are left", _REMEDY)
        return count

    def name(self) -> str:
        end = self.data.find(b"\0", self.position, self.position + MAX_NAME_BYTES + 1)
        if end < 0:
            problem = f"image name at byte {self.position} has no end within {MAX_NAME_BYTES} bytes"
            raise InputError(self.path, problem, _REMEDY)
        raw, self.position = self.data[self.position : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(self.path, f"image name {raw[:40]!r} is not UTF-8 text", "rename the image") from None

    def skip(self, size: int) -> None:
        self.position += size


def _cameras_binary(path: Path) -> Iterator[tuple[int, Lens]]:
    file = _Bytes(path)
    for _ in range(file.count(_CAMERA.size + 3 * 8)):
        number, model, width, height = file.take(_CAMERA)
        if model not in CAMERA_MODELS:
            raise InputError(path, f"camera {number} has the unknown model {model}", _UNDISTORT)
        name, count = CAMERA_MODELS[model]
        yield number, Lens(name, width, height, file.take(struct.Struct(f"<{count}d")), path)


def _images_binary(path: Path) -> Iterator[tuple[tuple, int, str]]:
    file = _Bytes(path)
    for _ in range(file.count(_IMAGE.size + 1 + 8)):
        _, *values, camera_id = file.take(_IMAGE)
        name = file.name()
        file.skip(file.count(_OBSERVATION_BYTES) * _OBSERVATION_BYTES)
        yield values, camera_id, name


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


def _numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    return enumerate(read_text(path).splitlines(), start=1)


def _is_record(line: str) -> bool:
    return bool(line.strip()) and not line.startswith("#")


def _broken(path: Path, number: int, line: str, what: str) -> InputError:
    return InputError(path, f"line {number} is not {what}: {line[:60]!r}", _REMEDY)


def _cameras_text(path: Path) -> Iterator[tuple[int, Lens]]:
    for number, line in _numbered_lines(path):
        if not _is_record(line):
            continue
        fields = line.split()
        try:
            camera_id, model, width, height = int(fields[0]), fields[1], int(fields[2]), int(fields[3])
            params = tuple(float(value) for value in fields[4:])
        except (ValueError, IndexError):
            raise _broken(path, number, line, "a camera (id, model, width, height, parameters)") from None
        if model not in PARAMETER_COUNTS:
            raise InputError(path, f"line {number} has the unknown camera model {model!r:.40}", _UNDISTORT)
        yield camera_id, Lens(model, width, height, params, path)


def _images_text(path: Path) -> Iterator[tuple[list[float], int, str]]:
    lines = _numbered_lines(path)
    for number, line in lines:
        if not _is_record(line):
            continue
        fields = line.split(maxsplit=9)
        try:
            values = [float(value) for value in fields[1:8]]
            camera_id, name = int(fields[8]), fields[9].strip()
        except (ValueError, IndexError):
            raise _broken(path, number, line, "an image (id, quaternion, translation, camera, name)") from None
        next(lines, None)  # the observations; an empty line, or none at the end of the file, where there are none
        yield values, camera_id, name


def _points_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = []
    for number, line in _numbered_lines(path):
        if not _is_record(line):
            continue
        try:
            row = [float(value) for value in line.split(maxsplit=7)[1:4]]
            row += [int(value) for value in line.split(maxsplit=7)[4:7]]
        except ValueError:
            raise _broken(path, number, line, "a point (id, x, y, z, r, g, b, ...)") from None
        if len(row) != 6 or not all(0 <= value <= 255 for value in row[3:]) or not all(map(math.isfinite, row[:3])):
            raise _broken(path, number, line, "a point with finite x, y, z and colours in 0..255")
        rows.append(row)
    table = np.array(rows, np.float64).reshape(-1, 6)
    return table[:, :3], table[:, 3:].astype(np.float32) / np.float32(255)
