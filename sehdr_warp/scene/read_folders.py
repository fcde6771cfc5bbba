"""Readers of folders without transforms: COLMAP, HDR-GS, HDR-NeRF's real sets, LLFF, and bare photos."""

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from ..errors import InputError
from ..files import has_file, read_bytes, read_json, read_lines, resolve_inside
from ..subsets import first_names
from .colmap_model import DISTORTED, SparseModel, find_model, other_models, read_model
from .copies import copies_note, find_copies
from .dataparser import NO_POINTS, UNPLACED, DataparserOutputs, ImageRecord, PointCloud, pose_from_camera_to_world
from .exposure import parse_seconds
from .heif import HEIF_SUFFIXES, register_heif
from .images import HDR_SUFFIXES, LDR_SUFFIXES, PHOTO_SUFFIXES
from .lens import Lens
from .linear_photos import color_matrix
from .names import (
    distinct,
    find_image,
    is_system_file,
    list_images,
    natural_key,
    renamed_note,
    sibling,
    view_and_exposure,
)
from .photos import FEWEST_PHOTOS, unusable_notes
from .sfm import reconstruct
from .sfm_panorama import are_panoramas, reconstruct_panoramas
from .stack import refuse_stack
from .unused_files import ARCHIVE_SUFFIXES, unread_kinds
from .video import UNSTITCHED_REMEDY, UNSTITCHED_SUFFIXES, VIDEO_SUFFIXES

_INPUT = "input"  # Folder of photos of 3DGS's convert.py, which writes undistorted copies to images/
_OTHERS = ("masks", "mask", "hdr", "exr")  # Folders of pictures that are not photos
# From the full size to reduced copies.
_IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8")
# HDR-NeRF's synthetic exposures, which HDR-GS's folders do not state (its train_synthetic.py holds them as constants).
_HDR_GS_SECONDS = (0.125, 0.5, 2.0, 8.0, 32.0)
_LOOKED_FOR = 20  # Images of a model by whose names their folder is found
_DEEPEST = 3  # Levels of folders in which photos are looked for, to name their folder
# By which a program states cameras, in lower case.
_POSE_FILES = {
    "cameras.xml": "Metashape", "bundle.out": "Bundler", "bundle.rd.out": "Bundler", "sfm_data.json": "OpenMVG",
    "cameras.sfm": "Meshroom", "model.nvm": "VisualSFM", "registration.csv": "RealityCapture",
    "mesh_info.json": "Polycam", "metadata.json": "Record3D", "arposes.txt": "ARKit",
}  # fmt: skip
_CAMERA_FILES = ("transforms.json", "reconstruction.json", "poses_bounds.npy")  # Beside a folder of photos
_REMEDY = "copy the images that COLMAP used"
_POSES_REMEDY = "export the poses again with LLFF's imgs2poses"


def image_folder(folder: Path) -> Path | None:
    """Return the folder of images, at full size if possible, or None."""
    return next((folder / name for name in _IMAGE_FOLDERS if (folder / name).is_dir()), None)


def model_fits(folder: Path, model: Path) -> bool:
    """Return whether a model is one of a set: it lies where COLMAP puts it, or photos of its names are there."""
    if model == find_model(folder) or model == folder:
        return True
    names = [image.name for image in read_model(model).images[:_LOOKED_FOR]]
    places = [place for place in (image_folder(folder), _folder_of(names, folder)) if place is not None]
    return any(find_image(place, name, model) for place in places for name in names)


def _folder_of(names: Sequence[str], folder: Path) -> Path | None:
    """Return the folder of a set, or one directly in it, that holds a photo under one of the exact names."""
    places = [folder, *sorted(place for place in folder.iterdir() if place.is_dir() and place.name not in _OTHERS)]
    inner = [name.replace("\\", "/") for name in names]
    files = ((place, name) for place in places for name in inner if not PurePosixPath(name).is_absolute())
    return next((place for place, name in files if ".." not in name and (place / name).is_file()), None)


def read_colmap(folder: Path) -> DataparserOutputs:
    """Parse a COLMAP set: one record for each image of the model, in the natural order of the names."""
    model, source = _model(folder)
    names = [image.name for image in model.images[:_LOOKED_FOR]]
    images = _images_of_model(source, names, folder) or _folder_of(names, folder)
    if images is None and source == folder:
        raise InputError(folder, "is a COLMAP model without photos", "give the folder that holds it and images/")
    if images is None:
        raise InputError(folder / "images", "folder not found", "put the photos that COLMAP used there")
    records, absent, photo_names = [], [], []
    held_out = _held_out_names(source)
    for entry in sorted(model.images, key=lambda image: natural_key(image.name)):
        image = find_image(images, entry.name, source)
        photo_names += [] if image is None else [(entry.name, image)]
        if image is not None and image.suffix.lower() in HDR_SUFFIXES and (photo := sibling(image, LDR_SUFFIXES)):
            hdr, image = image, photo
        elif image is None:
            absent.append(entry.name)
            continue
        else:
            hdr = None
        split = "test" if entry.name in held_out else "train" if held_out else None
        records.append(ImageRecord(image.stem, image, entry.lens, entry.world_to_camera, split=split, hdr=hdr))
    if not records:
        problem = f"none of the model's {len(absent)} images is here (the first is {absent[0]!r:.90})"
        others = unread_kinds(images)
        problem += f"; files of kinds that are not read: {others}" * bool(others)
        raise InputError(images, problem, _REMEDY)
    records, repeated = distinct(records)
    unusable = unusable_notes(model.unusable, len(model.images) + len(model.unusable))
    notes = [*other_models(source), *unusable, *renamed_note(photo_names), *repeated]
    if absent:
        notes.append(f"{len(absent)} images of the model are missing and were left out: {absent[0]!r:.90} ...")
    return DataparserOutputs("colmap", tuple(records), holdout=(8, 0), cloud=model.cloud, notes=tuple(notes))


def _held_out_names(source: Path) -> set[str]:
    """Return the images that a list beside a model holds out, as 3DGS reads it; none without the list."""
    listed = source / "test.txt"
    return {line.strip() for line in read_lines(listed, "surrogateescape")} - {""} if has_file(listed) else set()


def _images_of_model(source: Path, names: Sequence[str], folder: Path) -> Path | None:
    """Return the folder of images nearest above a model that holds one of the names, else the nearest, else None.

    Photos and undistorted copies may lie in one set: `images` belongs to `sparse`, `dense/images` to `dense/sparse`,
    and `input` to `distorted/sparse`.
    """
    if DISTORTED in source.relative_to(folder).parts and (folder / _INPUT).is_dir():
        return folder / _INPUT
    above = [place for place in source.parents if place.is_relative_to(folder)]
    places = [place for place in map(image_folder, dict.fromkeys((*above, folder))) if place is not None]
    holds = (place for place in places if any(find_image(place, name, source) for name in names))
    return next(holds, next(iter(places), None))


def is_hdr_gs(folder: Path) -> bool:
    """Return whether a folder has HDR-GS's synthetic layout.

    It has exposures of the same views, and truth in exr/ under the views' names: an exr/ of other files beside numbered
    photos of a COLMAP set does not count.
    """
    if not ((folder / "exr").is_dir() and (folder / "images").is_dir() and find_model(folder) is not None):
        return False
    exposures = _exposures_by_view(folder / "images")
    with_truth = sum(sibling(folder / "exr" / f"{view}.exr", HDR_SUFFIXES) is not None for view in exposures)
    return bool(exposures) and 2 * with_truth >= len(exposures)


def read_hdr_gs(folder: Path) -> DataparserOutputs:
    """Parse HDR-GS's synthetic layout: `images/<v>_<e>.png`, `exr/<v>.exr`, a model with one image of each view."""
    cloud, poses = _poses_by_view(folder)
    exposures, records = _exposures_by_view(folder / "images"), []
    seconds, notes = _hdr_gs_seconds(folder, 1 + max(key for files in exposures.values() for key in files))
    for view, (lens, pose) in poses.items():
        hdr = sibling(folder / "exr" / f"{view}.exr", HDR_SUFFIXES)
        hdr = hdr and resolve_inside(folder, hdr.relative_to(folder).as_posix(), folder)
        for key, image in sorted(exposures.get(view, {}).items()):
            records.append(ImageRecord(view, image, lens, pose, key, seconds[key] if seconds else None, hdr=hdr))
    if not records:
        raise InputError(folder / "images", "none of the model's images is in images/", _REMEDY)
    return DataparserOutputs("hdr-gs", tuple(records), "background", (2, 1), cloud, notes)


def _poses_by_view(folder: Path) -> tuple[PointCloud, dict[str, tuple]]:
    """Return the points, and lens and pose of each view (names without `_<exposure>`) in natural order."""
    model, source = _model(folder)
    poses = {}
    for entry in sorted(model.images, key=lambda image: natural_key(image.name)):
        view = re.sub(r"_\d+$", "", resolve_inside(folder, entry.name, source).stem)
        poses.setdefault(view, (entry.lens, entry.world_to_camera))
    return model.cloud, poses


def _model(folder: Path) -> tuple[SparseModel, Path]:
    source = find_model(folder, anywhere=True) or folder / "sparse"
    model = read_model(source)
    if not model.images and model.unusable:
        raise model.unusable[0]
    if not model.images:
        raise InputError(source, "the model has no registered views", "run structure from motion again")
    return model, source


def _exposures_by_view(images: Path) -> dict[str, dict[int, Path]]:
    by_view: dict[str, dict[int, Path]] = {}
    for image in images.iterdir():
        view, key = view_and_exposure(image.stem)
        if key is not None and image.suffix.lower() in LDR_SUFFIXES:
            by_view.setdefault(view, {})[key] = image
    return by_view


def _hdr_gs_seconds(folder: Path, count: int) -> tuple[list[float] | None, tuple[str, ...]]:
    """Return seconds by exposure number from `exposure_times.json`, or HDR-GS's constants, and notes."""
    path = folder / "exposure_times.json"
    if path.is_file():
        values = read_json(path).get("exposure_times")
        if not isinstance(values, list) or len(values) < count:
            raise InputError(path, f"exposure_times does not list {count} values", "list the seconds of every exposure")
        return [parse_seconds(value, path, f"exposure {i}") for i, value in enumerate(values)], ()
    if count == len(_HDR_GS_SECONDS):
        return list(_HDR_GS_SECONDS), (f"the set states no exposure times; took HDR-NeRF's {list(_HDR_GS_SECONDS)} s",)
    return None, ()


def read_hdr_nerf_real(folder: Path) -> DataparserOutputs:
    """Parse HDR-NeRF's real layout.

    `input_images/<view>_<k>.jpg`, and `poses_bounds_exps.npy` [n, 18] by sorted file names with seconds last. Poses of
    a `sparse/0` beside it (HDR-GS's edition) win, because there all exposures of a view have one pose.
    """
    path = folder / "poses_bounds_exps.npy"
    rows = _rows(path, 18)
    images = _images(folder / "input_images", path, len(rows))
    cloud, poses = _poses_by_view(folder) if find_model(folder) is not None else (NO_POINTS, None)
    records, absent = [], set()
    for row, image in zip(rows, images, strict=True):
        view, key = view_and_exposure(image.stem)
        if poses is not None and view not in poses:
            absent.add(view)
            continue
        lens, pose = _camera(row, path, image.name) if poses is None else poses[view]
        records.append(ImageRecord(view, image, lens, pose, exposure_key=key, exposure_time=float(row[17])))
    notes = (f"{len(absent)} views are not in the sparse model and were left out",) if absent else ()
    return DataparserOutputs("hdr-nerf-real", tuple(records), holdout=(2, 1), cloud=cloud, notes=notes)


def read_llff(folder: Path) -> DataparserOutputs:
    """Parse LLFF's layout: `images/` and `poses_bounds.npy` [n, 17], rows in the order of the sorted file names."""
    path = folder / "poses_bounds.npy"
    rows = _rows(path, 17)
    images = _images(folder / "images", path, len(rows))
    records = (
        ImageRecord(image.stem, image, *_camera(row, path, image.name)) for row, image in zip(rows, images, strict=True)
    )
    return DataparserOutputs("llff", tuple(records), holdout=(8, 0))


def _rows(path: Path, width: int) -> np.ndarray:
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


def _images(folder: Path, path: Path, count: int) -> list[Path]:
    if not folder.is_dir():
        raise InputError(folder, "folder not found", "copy the whole set")
    images = sorted(list_images(folder, LDR_SUFFIXES), key=lambda file: file.name)
    if len(images) != count:
        raise InputError(path, f"has {count} rows for {len(images)} images in {folder.name}/", "copy the whole set")
    return images


def _camera(row: np.ndarray, path: Path, name: str) -> tuple[Lens, np.ndarray]:
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


def find_photos(folder: Path) -> DataparserOutputs:
    """Parse bare photos of a folder, or its `images/` or `input/`: records without cameras, which place_photos() adds.

    Raises:
        InputError: if there are none, or too few.
    """
    places = (place for place in (folder, folder / "images", folder / _INPUT) if place.is_dir())
    candidates = [list_images(place, PHOTO_SUFFIXES) for place in places]
    # A single picture beside `images/` is a cover.
    photos = next((each for each in candidates if len(each) > 1), next(filter(None, candidates), []))
    if not photos:
        if heif := next((file for file in sorted(folder.iterdir()) if file.suffix.lower() in HEIF_SUFFIXES), None):
            register_heif(heif)
        others = unread_kinds(folder)
        problem = "has no photos and no known layout" + f"; it holds {others}" * bool(others)
        raise InputError(folder, problem, _remedy_without_photos(folder))
    if len(photos) == 1 and (inner := _folders_with_photos(folder)):
        raise InputError(
            photos[0], "is the only photo there", f"give one of its folders with photos: {first_names(inner, 5)}"
        )
    copies = find_copies(photos)
    photos = [photo for photo in photos if photo not in copies]
    _require_photos(len(photos), photos[0], folder)
    notes = [*copies_note(copies), *_foreign_poses(folder)]
    if model := find_model(folder, anywhere=True):
        place = model.relative_to(folder).as_posix()
        notes.append(f"the COLMAP model in {place} names none of these photos and is not used")
    for place in ("sparse/0", "sparse"):
        if not model and any((folder / place / f"images{end}").is_file() for end in (".bin", ".txt")):
            notes.append(f"{place} is not read, because it has no cameras.bin or cameras.txt: cameras are found anew")
    if photos[0].parent == folder and (inner := [name for name in _folders_with_photos(folder) if name not in _OTHERS]):
        notes.append(f"photos in folders of it are not read: {first_names(inner, 5)}")
    records = (ImageRecord(photo.stem, photo, UNPLACED, np.eye(4), oriented=True) for photo in photos)
    names = tuple(photo.name for photo in copies)
    return DataparserOutputs("photos", tuple(records), notes=tuple(notes), mentioned=names)


def place_photos(
    dataset: DataparserOutputs, records: Sequence[ImageRecord], folder: Path, kind: str, cache: Path | str | None
) -> tuple[DataparserOutputs, list[ImageRecord], list[str]]:
    """Find the cameras of bare photos, as find_photos() returned them, by structure from motion; see reconstruct().

    Returns:
        The dataset with its points, the photos that could be placed, and the names of the others.

    Raises:
        InputError: if the photos are an exposure stack, or of several cameras' sensors, or cannot be placed.
    """
    photos = [record.image for record in records]
    _require_photos(len(photos), photos[0], folder)
    if kind == "raw":
        color_matrix(photos)  # Refuse photos of several cameras before minutes of matching.
    refuse_stack(photos, folder)
    try:
        reconstruction = reconstruct_panoramas(photos, cache) if are_panoramas(photos) else reconstruct(photos, cache)
    except InputError as error:
        if poses := _foreign_poses(folder):
            raise InputError(error.path, error.problem, poses[0]) from None
        raise
    cameras = {int(Path(image.name).stem): image for image in reconstruction.model.images}
    result = [
        replace(record, lens=image.lens, world_to_camera=image.world_to_camera)
        for i, record in enumerate(records)
        if (image := cameras.get(i)) is not None
    ]
    unplaced = [record.image.name for i, record in enumerate(records) if i not in cameras]
    return (
        replace(dataset, cloud=reconstruction.model.cloud, notes=(*dataset.notes, *reconstruction.notes(photos))),
        result,
        unplaced,
    )


def _require_photos(count: int, first: Path, folder: Path) -> None:
    if count < 2:
        raise InputError(first, "is the only photo; one view does not show depth", "add photos from other places")
    if count < FEWEST_PHOTOS:
        problem = f"holds {count} photos: depth and light cannot be told apart from so few"
        raise InputError(folder, problem, f"take {FEWEST_PHOTOS} or more from different places, better 20")


def _remedy_without_photos(folder: Path) -> str:
    """Return what to give in place of a folder that holds no photos."""
    with suppress(OSError):
        if inner := _folders_with_photos(folder):
            poses = "".join(f"; {note}" for note in _foreign_poses(folder))
            return f"give one of its folders with photos: {first_names(inner, 5)}{poses}"
        for file in sorted(folder.iterdir()):
            suffix = file.suffix.lower()
            if suffix in VIDEO_SUFFIXES:
                return f"give the clip itself: {file.name}"
            if suffix in ARCHIVE_SUFFIXES:
                return f"unpack {file.name}, and give the folder with its photos"
            if suffix in UNSTITCHED_SUFFIXES:
                return UNSTITCHED_REMEDY
    return "give photos (JPEG, PNG, TIFF, HEIC, RAW, EXR), a COLMAP set or a transforms.json"


def _folders_with_photos(folder: Path) -> list[str]:
    """List folders with photos below a folder, at most _DEEPEST levels down, as paths relative to it.

    Of a set with cameras it is the folder of the set.
    """
    result: dict[str, None] = {}
    for root, folders, _ in os.walk(folder):
        place = Path(root).relative_to(folder)
        deepest = len(place.parts) >= _DEEPEST
        folders[:] = [] if deepest else sorted(name for name in folders if not is_system_file(name))
        if place.parts and list_images(folder / place, PHOTO_SUFFIXES):
            above = folder / place.parent
            has_cameras = any((above / name).is_file() for name in _CAMERA_FILES) or find_model(above) is not None
            is_set = place.parent.parts and has_cameras
            result[(place.parent if is_set else place).as_posix()] = None
    return list(result)


def _foreign_poses(folder: Path) -> list[str]:
    """Return a note on poses of other programs beside bare photos: they are not read, and cameras are found anew."""
    names = {file.name.lower() for file in folder.iterdir() if file.is_file()}
    tools = [f"{tool} ({file})" for file, tool in _POSE_FILES.items() if file in names]
    if not tools:
        return []
    return [f"poses of {', '.join(tools)} are not read, cameras are found anew: export them for COLMAP or nerfstudio"]
