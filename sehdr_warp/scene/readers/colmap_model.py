"""Reader of COLMAP's sparse models, binary and text (https://colmap.github.io/format.html), safe for hostile files."""

import logging
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...files import read_bytes, read_lines
from ..dataparser import NO_POINTS, PointCloud, pose_from_quaternion
from ..file_names import is_system_file
from ..lens import CAMERA_MODELS, Lens

_log = logging.getLogger("sehdr_warp.scene")
# pycolmap is not used here: it hangs on a damaged count and accepts a truncated file as a whole one.
MAX_NAME_BYTES = 4096
_DEEPEST = 3  # Levels of folders below a set in which a model is looked for
_MOST_PLACES = 1000  # Folders of a level that are looked at
DISTORTED = "distorted"  # Folder in which 3DGS's convert.py puts the model of the photos in input/
_NO_MODELS = {DISTORTED, "images", "input"}
_REMEDY = "export the model again with COLMAP"
_COPY_REMEDY = "copy the whole model again, or train on the folder of photos alone"
_KINDS = ((".bin", ".bin"), (".txt", ".txt"), (".bin", ".txt"), (".txt", ".bin"))  # Of cameras and images


@dataclass(frozen=True)
class ModelImage:
    """A registered image."""

    name: str  # As stored, not yet trusted as a path
    lens: Lens  # Intrinsics
    world_to_camera: np.ndarray  # [4, 4]


@dataclass(frozen=True)
class SparseModel:
    """A reconstruction."""

    images: tuple[ModelImage, ...]  # In the file's order
    cloud: PointCloud  # Its points
    unusable: tuple[InputError, ...] = ()  # Errors of images whose poses cannot be, and which are not in `images`


def find_model(folder: Path, *, anywhere: bool = False) -> Path | None:
    """Return the folder that holds a model's cameras, or None.

    Looks for sparse/0, sparse, or a text export (sparse/txt, sparse_txt, sparse_txt/0) in the folder itself, then in
    its colmap/, dense/, dense/0/ and distorted/; `anywhere` also in the folder without sparse/ and in folders that are
    not sets. Of several models sparse/0, sparse/1 ... it is the one with the most images.
    """
    first = next(usual_models(folder), None) or (_model_elsewhere(folder) if anywhere else None)
    if first is None or first.name != "0":
        return first
    models = _by_number(first.parent)
    counts = {model: _image_count(model) for model in models} if len(models) > 1 else {first: 0}
    return max(counts, key=lambda model: counts[model])


def usual_models(folder: Path) -> Iterator[Path]:
    """Yield the models that lie where COLMAP and 3DGS put them in a folder, the most specific place first."""
    names = ("sparse/0", "sparse", "sparse/txt", "sparse_txt", "sparse_txt/0")
    places = (folder / above / name for above in (".", "colmap", "dense", "dense/0", DISTORTED) for name in names)
    return filter(_is_model, places)


def has_images(model: Path) -> bool:
    """Return whether a model has a file of its images, whose poses cameras and points do not state."""
    return any((model / f"images{end}").is_file() for end in (".bin", ".txt"))


def _is_whole_model(place: Path) -> bool:
    return any(all((place / f"{name}{end}").is_file() for name in ("cameras", "images")) for end in (".bin", ".txt"))


def _model_elsewhere(folder: Path) -> Path | None:
    """Return the model nearest to a folder, at most _DEEPEST levels down, that is not in a set of its own."""
    places = [folder]
    for _ in range(_DEEPEST + 1):
        if models := [place for place in places if _is_whole_model(place)]:
            return max(models, key=_image_count) if len(models) > 1 else models[0]
        inner: list[Path] = []
        for place in places:
            with suppress(OSError), os.scandir(place) as entries:
                names = sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))
                inner += [place / name for name in names if name not in _NO_MODELS and not is_system_file(name)]
        # A folder with `images` is a set of its own.
        places = [each for each in inner[:_MOST_PLACES] if not (each / "images").is_dir()]
    return None


def other_models(model: Path) -> list[str]:
    """Return a note on the models that lie beside the one that is used; none if there are no others."""
    models = _by_number(model.parent) if model.name.isdecimal() else []
    if not models and model.parent.name.lower() == "sparse":
        models = sorted(place for place in model.parent.iterdir() if place.is_dir() and _is_whole_model(place))
    if len(models) < 2:
        return []
    others = ", ".join(f"{each.name} ({_image_count(each)} images)" for each in models if each != model)
    place = f"{model.parent.name}/{model.name}"
    return [f"{place} is used, the largest model ({_image_count(model)} images); not used: {others}"]


def _is_model(place: Path) -> bool:
    return any((place / f"cameras{end}").is_file() for end in (".bin", ".txt"))


def _by_number(parent: Path) -> list[Path]:
    """List the models sparse/0, sparse/1 ... in their order."""
    places = [place for place in parent.iterdir() if place.name.isdecimal() and _is_model(place)]
    return sorted(places, key=lambda place: int(place.name))


def _image_count(model: Path) -> int:
    """Return how many images a model lists, 0 if that cannot be read."""
    try:
        if (model / "images.bin").is_file():
            with (model / "images.bin").open("rb") as file:
                return struct.unpack("<Q", file.read(8))[0]
        return sum(1 for _ in _image_records(model / "images.txt"))
    except (OSError, struct.error, InputError):
        return 0


def read_model(folder: Path, *, points: bool = True) -> SparseModel:
    """Read cameras, images and (if present, and unless `points` is False) points3D, binary files before text files.

    Raises:
        InputError: if a file is missing, empty, damaged or truncated, or holds impossible values.
    """
    camera_path, image_path = _model_files(folder)
    cameras: dict[int, Lens] = {}
    in_binary = _cameras_binary(camera_path) if camera_path.suffix == ".bin" else None
    for number, *lens in in_binary or _records(camera_path, "a camera", _camera):
        if number in cameras:
            raise InputError(camera_path, f"camera {number} is listed twice", _REMEDY)
        cameras[number] = Lens(*lens, source=camera_path)
    images: dict[str, ModelImage | InputError] = {}
    in_binary = _images_binary(image_path) if image_path.suffix == ".bin" else None
    for pose, number, name in in_binary or _image_records(image_path):
        if not name or len(os.fsencode(name)) > MAX_NAME_BYTES:
            problem = f"image name {name[:40]!r} is empty or longer than {MAX_NAME_BYTES} bytes"
            raise InputError(image_path, problem, "rename the image")
        if name in images:
            raise InputError(image_path, f"image {name!r:.90} is listed twice", _REMEDY)
        if number not in cameras:
            raise InputError(image_path, f"image {name!r:.90} has camera {number}, which is not listed", _REMEDY)
        try:
            world_to_camera = pose_from_quaternion(pose[:4], pose[4:], image_path, name)
            images[name] = ModelImage(name, cameras[number], world_to_camera)
        except InputError as error:
            images[name] = error
    usable = tuple(image for image in images.values() if isinstance(image, ModelImage))
    unusable = tuple(error for error in images.values() if isinstance(error, InputError))
    return SparseModel(usable, read_points(folder) if points else NO_POINTS, unusable)


def _model_files(folder: Path) -> tuple[Path, Path]:
    """Return the files of a model's cameras and images: both binary if possible, else both text, else what is there.

    Raises:
        InputError: if one of them is missing.
    """
    kinds = [(folder / f"cameras{one}", folder / f"images{two}") for one, two in _KINDS]
    for pair in kinds:
        if all(path.is_file() for path in pair):
            return pair
    names = sorted(path.name for path in {path for pair in kinds for path in pair} if path.is_file())
    missing = "images" if any(name.startswith("cameras") for name in names) else "cameras"
    problem = f"has {', '.join(names) or 'no model'}, but no {missing}.bin or {missing}.txt"
    raise InputError(folder, problem, "copy the whole model, or remove its folder to train without it")


def read_points(folder: Path) -> PointCloud:
    """Read the points of points3D.bin, .txt or .ply; none if there is no such file, or if it is empty."""
    readers = {".bin": _points_binary, ".txt": _points_text, ".ply": read_ply_points}
    for name in ("points3D.bin", "points3D.txt", "points3D.ply", "points3d.ply"):
        # COLMAP asks for an empty file where poses are known and points are not.
        if (path := folder / name).is_file() and path.stat().st_size:
            return readers[path.suffix](path)
    return NO_POINTS


def read_ply_points(path: Path) -> PointCloud:
    """Read positions and colors of a PLY file's vertices, grey if it has no colors.

    Raises:
        InputError: if the file is damaged.
    """
    from plyfile import PlyData

    read_bytes(path)
    try:
        vertex = PlyData.read(str(path))["vertex"].data
        points = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
        colors = np.full(points.shape, 0.5)
        if {"red", "green", "blue"} <= set(vertex.dtype.names):
            colors = np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1)
            colors = colors / 255 if np.issubdtype(colors.dtype, np.integer) else colors
    # plyfile raises many kinds of exceptions for damaged files.
    except Exception as error:  # noqa: BLE001
        raise InputError(path, f"cannot be read as PLY points ({error!r:.120})", "export the points again") from None
    return _checked_points(points, np.clip(colors, 0, 1), path)


def _checked_points(points: np.ndarray, colors: np.ndarray, path: Path) -> PointCloud:
    good = np.isfinite(points).all(axis=1) & np.isfinite(colors).all(axis=1)
    if not good.all():
        _log.warning(
            "%s: %d of %d points are not finite and are left out", path, len(points) - int(good.sum()), len(points)
        )
    return PointCloud(points[good], colors[good].astype(np.float32))


class _Bytes:
    """A cursor over a file that never reads past its end."""

    def __init__(self, path: Path):
        self.path, self.data, self.position = path, read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        size = struct.calcsize(layout)
        if self.position + size > len(self.data):
            raise InputError(self.path, f"ends early, at byte {len(self.data)}", _COPY_REMEDY)
        self.position += size
        return struct.unpack_from(layout, self.data, self.position - size)

    def count(self, smallest: int) -> int:
        """Read a 64-bit count of records that take at least `smallest` bytes each."""
        (count,) = self.take("<Q")
        remaining = len(self.data) - self.position
        if count * smallest > remaining:
            problem = f"is cut short or damaged: count {count} needs {count * smallest} bytes, but {remaining} are left"
            raise InputError(self.path, problem, _COPY_REMEDY)
        return count

    def skip_list(self, size: int) -> None:
        count = self.count(size)
        self.position += size * count

    def name(self) -> str:
        end = self.data.find(b"\0", self.position, self.position + MAX_NAME_BYTES + 1)
        if end < 0:
            problem = f"image name at byte {self.position} has no end within {MAX_NAME_BYTES} bytes"
            raise InputError(self.path, problem, _REMEDY)
        raw, self.position = self.data[self.position : end], end + 1
        return os.fsdecode(raw)


def _cameras_binary(path: Path) -> Iterator[tuple]:
    file = _Bytes(path)
    for _ in range(file.count(24 + 3 * 8)):
        number, model, width, height = file.take("<IiQQ")
        if model not in CAMERA_MODELS:
            raise InputError(path, f"camera {number} has the unknown model {model}", "undistort with COLMAP first")
        name, count = CAMERA_MODELS[model]
        yield number, name, width, height, file.take(f"<{count}d")


def _images_binary(path: Path) -> Iterator[tuple]:
    file = _Bytes(path)
    for _ in range(file.count(64 + 1 + 8)):
        _, *pose, camera_id = file.take("<I7dI")
        name = file.name()
        file.skip_list(24)
        yield pose, camera_id, name


def _points_binary(path: Path) -> PointCloud:
    file = _Bytes(path)
    table = np.empty((file.count(43 + 8), 6))
    for row in table:
        row[:] = file.take("<Q3d3Bd")[1:7]
        file.skip_list(8)
    return _checked_points(table[:, :3], table[:, 3:] / 255, path)


def _records(path: Path, what: str, parse: Callable[[str], tuple]) -> Iterator[tuple]:
    """Parse the lines of a text file except empty ones and comments; ValueError becomes an InputError."""
    for number, line in enumerate(read_lines(path), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield _parse(path, number, line, what, parse)


def _image_records(path: Path) -> Iterator[tuple]:
    """Parse the images of images.txt.

    A line of observations follows each image. It is empty for an image without any, and missing in files of scripts for
    known poses: there the next line is an image again.
    """
    after_image = False
    for number, line in enumerate(read_lines(path, "surrogateescape"), start=1):
        if line.lstrip().startswith("#"):
            continue
        if not line.strip() or (after_image and _is_observations(line)):
            after_image = False
        else:
            yield _parse(path, number, line, "an image", _image)
            after_image = True


def _is_observations(line: str) -> bool:
    """Return whether a line is a list of (x, y, point) and not an image: ten fields, the last of which is a name."""
    fields = line.split()
    if len(fields) % 3:
        return False
    try:
        for field in (*fields[:30], *fields[-3:]):
            float(field)
    except ValueError:
        return False
    return True


def _parse(path: Path, number: int, line: str, what: str, parse: Callable[[str], tuple]) -> tuple:
    try:
        return parse(line)
    except ValueError:
        raise InputError(path, f"line {number} is not {what}: {line[:60]!r}", _REMEDY) from None


def _camera(line: str) -> tuple:
    number, model, width, height, *params = line.split()
    sizes = float(width), float(height)
    if not all(size.is_integer() for size in sizes):
        raise ValueError
    return int(number), model.upper(), *map(int, sizes), tuple(map(float, params))


def _image(line: str) -> tuple:
    _, *pose, camera_id, name = line.split(maxsplit=9)
    if len(pose) != 7:
        raise ValueError
    return [float(value) for value in pose], int(camera_id), name.strip()


def _point(line: str) -> tuple:
    _, x, y, z, *color = line.split(maxsplit=7)[:7]
    color = [int(float(value)) for value in color]
    if len(color) != 3 or not 0 <= min(color) <= max(color) <= 255:
        raise ValueError
    return float(x), float(y), float(z), *color


def _points_text(path: Path) -> PointCloud:
    table = np.array([*_records(path, "a point with x, y, z and colors in 0..255", _point)], np.float64).reshape(-1, 6)
    return _checked_points(table[:, :3], table[:, 3:] / 255, path)
