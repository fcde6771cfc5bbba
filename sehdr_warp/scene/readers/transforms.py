"""Reader of transforms.json as nerfstudio, instant-ngp and Blender write it."""

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any

import numpy as np

from ...errors import InputError
from ...files import read_json, resolve_inside
from ...subsets import counted, first_names
from ..dataparser import NO_POINTS, DataparserOutputs, ImageRecord, PointCloud, pose_from_camera_to_world
from ..exposure.times import parse_seconds
from ..file_names import distinct, find_image, find_images, image_folder, photo_and_truth, plain_path, renamed_note
from ..images.ldr_files import PHOTO_SUFFIXES
from ..photos import unusable_notes
from .colmap_model import find_model, read_ply_points, read_points
from .transforms_lens import frame_lens

_REMEDY = "correct the file or export it again"
INCOMPLETE = "copy the whole set"
_UNREAD = (
    "rolling_shutter", "transform_matrix_end", "fisheye_crop_radius", "depth_file_path", "depth_path", "mask_color",
    "white_transparent", "black_transparent",
)  # fmt: skip
"""Fields of nerfstudio and instant-ngp that change what a photo shows or what is known of it."""
_TIMES = {"exposure_time": "", "exposure_time_ms": "ms", "exposure_time_us": "us"}
_VARYING = {
    "what moves is not modeled": ("time",),
    "exposure_time has to contain it": (
        "iso", "ISO", "gain", "aperture", "f_number", "exposure", "ev", "shutter_speed",
    ),
}  # fmt: skip
"""Fields that are not read, and what follows if their values differ between frames."""


def is_transforms(path: Path) -> bool:
    """Return whether a file states frames as nerfstudio's transforms.json does, whatever its name."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    head = b""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(1 << 16)
    return b'"frames"' in head and b'"transform_matrix"' in head


def read_transforms(folder: Path, file: Path | None = None) -> DataparserOutputs:
    """Parse transforms.json, or transforms_{train,test}.json (val if there is no test): one record for each frame.

    `file` is read in place of them.
    """
    if file is not None or (folder / "transforms.json").is_file():
        files = [(file or folder / "transforms.json", None)]
    else:
        other = "test" if (folder / "transforms_test.json").is_file() else "val"
        files = [(folder / "transforms_train.json", "train"), (folder / f"transforms_{other}.json", "test")]
    read, cloud, missing = _Frames(), NO_POINTS, []
    for path, split in files:
        if split == "test" and not path.is_file():
            continue
        values = read_json(path)
        read.add_file(folder, path, values, split)
        if not len(cloud[0]):
            cloud = _points(folder, path, values)
        points_file = values.get("ply_file_path")
        if isinstance(points_file, str) and _points_file(folder, points_file, path) is None:
            missing.append(f"the points that {path.name} states are not here: {points_file!r:.90}")
    notes = read.notes(folder)
    records, repeated = distinct(read.records)
    records, unmasked = _without_missing_masks(records)
    notes += [*repeated, *missing, *unmasked]
    in_splits = [record for record in records if record.split]
    if 0 < len(in_splits) < len(records):
        count = len(records) - len(in_splits)
        notes.append(f"{count} frames belong to neither the train nor the test split and were left out")
    names = tuple(Path(error.path).name for error in read.unusable)
    return DataparserOutputs(
        "transforms", tuple(in_splits or records), "background", cloud=cloud, notes=tuple(notes), mentioned=names
    )


@dataclass
class _Frames:
    """Frames of transforms.json."""

    records: list[ImageRecord] = field(default_factory=list)  # Of the frames that can be used
    absent: list[str] = field(default_factory=list)  # Names of frames without a photo
    photos: dict[str, Path | None] = field(default_factory=dict)  # By the names of the frames, None for one without
    unusable: list[InputError] = field(default_factory=list)  # Errors of poses and photos, whose frames are left out
    untimed: list[InputError] = field(default_factory=list)  # Errors of exposure times, which are left out
    unread: set[str] = field(default_factory=set)  # Fields of _UNREAD that the files state
    varying: dict[str, set[str]] = field(default_factory=dict)  # Values of the fields of _VARYING

    def add_file(self, folder: Path, path: Path, values: dict, split: str | None) -> None:
        """Add the frames of a file; `split` is that of all of them, None if the file states it by frame."""
        frames = frames_of(values, path)
        splits = {} if split else _named_splits(values, frames) or _splits_beside(path, frames)
        images = _frame_images(folder, [name for name, _ in frames], path)
        self.photos |= images
        for name, frame in frames:
            fields = values | frame
            self.unread |= {key for key in _UNREAD if _is_set(fields.get(key))}
            for name_of_field in itertools.chain(*_VARYING.values()):
                self.varying.setdefault(name_of_field, set()).add(repr(fields.get(name_of_field)))
            image = images[name]
            try:
                pose = frame_pose(frame, path, name, mitsuba=fields.get("from_mitsuba") is True)
            except InputError as error:
                self.unusable.append(error)
                continue
            if image is None:
                self.absent.append(name)
                continue
            image, hdr = photo_and_truth(image)
            try:
                lens = frame_lens(values, frame, image, path)
            except InputError as error:
                if error.path != str(image):
                    raise
                self.unusable.append(error)
                continue
            mask = _mask_file(folder, frame["mask_path"], path) if frame.get("mask_path") else None
            times = ((fields[key], unit) for key, unit in _TIMES.items() if fields.get(key) is not None)
            time, unit = next(times, (None, ""))
            try:
                seconds = None if time is None else parse_seconds(time, path, name, unit)
            except InputError as error:
                self.untimed.append(error)
                seconds = None
            own_split = split or splits.get(plain_path(name))
            record = ImageRecord(image.stem, image, lens, pose, None, seconds, own_split, mask, hdr)
            self.records.append(record)

    def notes(self, folder: Path) -> list[str]:
        """Return notes on frames and fields that cannot be used; raise InputError if too few frames can."""
        count = len(self.records)
        notes = unusable_notes(self.unusable, count + len(self.absent) + len(self.unusable))
        if not count:
            problem = f"image file not found, nor any of {len(self.absent)} frames"
            images = find_images(folder, self.absent, folder)
            place = next((image.parent.relative_to(folder) for image in images.values() if image), None)
            remedy = INCOMPLETE if place is None else f"photos of these names are in {place}: rename it to images"
            raise InputError(folder / plain_path(self.absent[0]), problem, remedy)
        notes += [*absent_note(self.absent, count), *renamed_note(self.photos)]
        if 2 * len(self.untimed) > count:
            raise self.untimed[0]
        if self.untimed:
            problem = self.untimed[0].problem
            notes.append(f"{len(self.untimed)} of {count} frames state no usable exposure time: {problem}")
        if self.unread:
            notes.append(f"fields of the frames that are not read: {', '.join(sorted(self.unread))}")
        for consequence, names in _VARYING.items():
            for name in (name for name in names if len(self.varying[name]) > 1):
                values = f"{len(self.varying[name])} values"
                notes.append(f"frames differ in {name} ({values}), which is not read: {consequence}")
        return notes


def _is_set(value: Any) -> bool:
    """Return whether a value of JSON, or one in its lists, is neither 0 nor empty."""
    return any(map(_is_set, value)) if isinstance(value, list) else bool(value)


def frames_of(values: dict, path: Path) -> list[tuple[str, dict]]:
    """Return (file_path, frame) of each frame; raise InputError if there are no frames or one has no file_path."""
    frames = values.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(path, "has no frames", _REMEDY)
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(path, f"frame {i} has no file_path", _REMEDY)
    return [(frame["file_path"], frame) for frame in frames]


def _named_splits(values: dict, frames: list[tuple[str, dict]]) -> dict[str, str]:
    """Return splits by plain_path() file_path: nerfstudio's <split>_filenames, or a frame's own "split"."""
    split_names = ("train", "test", "val")
    by_name = {plain_path(name): frame["split"] for name, frame in frames if frame.get("split") in split_names}
    for split in ("train", "val", "test"):
        filenames = values.get(f"{split}_filenames")
        if isinstance(filenames, list):
            by_name.update({plain_path(name): split for name in filenames if isinstance(name, str)})
    return _train_and_test(by_name)


def _splits_beside(path: Path, frames: list[tuple[str, dict]]) -> dict[str, str]:
    """Return splits by plain_path() file_path: of <file>_<split>.json beside a file, if they list all its frames."""
    by_name: dict[str, str] = {}
    for split in ("test", "val", "train"):  # What several list is trained on.
        other = path.with_name(f"{path.stem}_{split}.json")
        with suppress(InputError):  # Files that cannot be read list nothing.
            names = frames_of(read_json(other), other) if other.is_file() else []
            by_name |= {plain_path(name): split for name, _ in names}
    return _train_and_test(by_name) if all(plain_path(name) in by_name for name, _ in frames) else {}


def _train_and_test(by_name: dict[str, str]) -> dict[str, str]:
    """Return the splits train and test of names; val stands for test if there is none."""
    splits = {"train": "train", "test" if "test" in by_name.values() else "val": "test"}
    return {name: splits[split] for name, split in by_name.items() if split in splits}


def absent_note(absent: list[str], count: int) -> tuple[str, ...]:
    """Return a note on frames, `absent` by name, whose photos are missing beside `count` frames that have one."""
    if not absent:
        return ()
    names_text = first_names(absent)
    return (f"{len(absent)} of {len(absent) + count} frames have no photo and were left out: {names_text}",)


def _without_missing_masks(records: list[ImageRecord]) -> tuple[list[ImageRecord], tuple[str, ...]]:
    """Return photos without the masks that their frames state and that are not there, and a note on these."""
    absent = [record.mask for record in records if record.mask is not None and not record.mask.is_file()]
    if not absent:
        return records, ()
    are = "masks that frames state are not here, and their photos count whole"
    count = counted(len(absent), "mask that a frame states is not here, and its photo counts whole", are)
    note = f"{count}: {first_names([mask.name for mask in absent])}"
    return [replace(record, mask=None) if record.mask in absent else record for record in records], (note,)


def _frame_images(folder: Path, names: Sequence[str], path: Path) -> dict[str, Path | None]:
    """Return the photo of each frame, None if there is no such file.

    If none is where the file says, they are looked for in the folder of images, because of some sets images_4 alone is
    public. Without such a folder they may lie beside the file: no deeper, because folders of another split or of depth
    maps hold the same names.
    """
    images = {name: _frame_image(folder, name, path) for name in names}
    if any(images.values()):
        return images
    if inner := image_folder(folder):
        return find_images(inner, names, path)
    beside = {name: _frame_image(folder, PureWindowsPath(name).name, path) for name in names}
    images_beside = [image for image in beside.values() if image is not None]
    return beside if len(set(images_beside)) == len(images_beside) else images


def _frame_image(folder: Path, name: str, path: Path) -> Path | None:
    """Return the photo of a frame, None if there is no such file."""
    # Blender's file_path has no ending; a dot in the stem is not one.
    has_suffix = PurePath(name).suffix.lower() in PHOTO_SUFFIXES
    full = name if has_suffix else f"{name}.png"
    image = find_image(folder, full, path)
    if image is None and (folder / "images").is_dir():
        image = find_image(folder / "images", full, path)
    if image is None and not has_suffix and (other := find_image(folder, name, path)) is not None:
        # Of a kind that is not read, such as .jxl: what it is will be named.
        image = other if other.name == PureWindowsPath(name).name else None
    return image


def _mask_file(folder: Path, name: Any, path: Path) -> Path:
    """Return the mask that a frame states, by the rules of photos' names; a path without a file if it is not there."""
    if not isinstance(name, str):
        return resolve_inside(folder, name, path)
    return find_image(folder, name, path) or folder / PureWindowsPath(name).name


def _points_file(folder: Path, name: str, path: Path) -> Path | None:
    """Return the file of points that a set states, None if it is not there; names as find_image() reads them."""
    file = find_image(folder, name, path) if name else None
    return file if file is not None and file.suffix.lower() == ".ply" else None


def _matrix(values) -> np.ndarray:
    """Return the array of JSON values, or an empty one if they are not numbers."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def frame_pose(frame: dict, path: Path, name: str, *, mitsuba: bool = False) -> np.ndarray:
    """Return world_to_camera [4, 4] of a frame's transform_matrix; `mitsuba` if its x axis is left and z is ahead.

    Raises:
        InputError: if it is not a pose.
    """
    matrix = _matrix(frame.get("transform_matrix"))
    matrix = matrix.reshape(4, 4) if matrix.shape == (16,) else matrix
    if mitsuba and matrix.shape[1:] == (4,):
        matrix[:3, (0, 2)] *= -1
    return pose_from_opengl(matrix, path, name)


def pose_from_opengl(matrix: np.ndarray, path: Path, name: str) -> np.ndarray:
    """Return world_to_camera [4, 4] of a camera-to-world matrix in OpenGL axes; see pose_from_camera_to_world."""
    if matrix.shape in ((4, 4), (3, 4)):
        matrix[:3, 1:3] *= -1  # From x right, y up, -z forward to y down, z forward.
    return pose_from_camera_to_world(matrix, path, name)


def _points(folder: Path, path: Path, values: dict) -> PointCloud:
    """Read ply_file_path (in the frames' coordinates), or nerfstudio's COLMAP model moved by applied_transform."""
    name = values.get("ply_file_path")
    if isinstance(name, str) and (ply := _points_file(folder, name, path)) is not None:
        return read_ply_points(ply)
    points, colors = sparse_points(folder)
    if len(points) and values.get("applied_transform") is not None:
        matrix = _matrix(values["applied_transform"])
        if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
            raise InputError(path, "applied_transform is not a finite 3 x 4 matrix", _REMEDY)
        points = points @ matrix[:3, :3].T + matrix[:3, 3]
    scale = values.get("applied_scale")
    if isinstance(scale, int | float) and 0 < scale < np.inf:
        points = points * float(scale)
    if not np.isfinite(points).all():
        raise InputError(path, "applied_transform and applied_scale move points to infinity", _REMEDY)
    return PointCloud(points, colors)


def sparse_points(folder: Path) -> PointCloud:
    """Return the points of the COLMAP model of a set, or of points3D files in it; none without them."""
    places = (find_model(folder), folder / "sparse" / "0", folder / "sparse", folder)
    clouds = (read_points(place) for place in places if place is not None)
    return next((cloud for cloud in clouds if len(cloud[0])), NO_POINTS)
