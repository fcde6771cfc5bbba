"""Reader of COLMAP sets: a sparse model, and the photos of its names."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from ...errors import InputError
from ...files import has_file, read_lines
from ...subsets import counted
from ..dataparser import DataparserOutputs, ImageRecord
from ..file_names import (
    INPUT,
    LOOKED_FOR,
    OTHER_FOLDERS,
    distinct,
    find_image,
    find_images,
    image_folder,
    list_images,
    natural_key,
    photo_and_truth,
    renamed_note,
)
from ..images.ldr_files import PHOTO_SUFFIXES
from ..photos import unusable_notes
from ..unused_files import unread_kinds
from .colmap_model import DISTORTED, SparseModel, find_model, other_models, read_model, usual_models

IMAGES_REMEDY = "copy the images that COLMAP used"


def model_fits(folder: Path, model: Path) -> bool:
    """Return whether a model is one of a set: it lies where COLMAP puts it, or photos of its names are there."""
    if model == find_model(folder) or model == folder:
        return True
    names = [image.name for image in read_model(model, points=False).images[:LOOKED_FOR]]
    places = [place for place in (image_folder(folder), _folder_of(names, folder)) if place is not None]
    return any(find_image(place, name, model) for place in places for name in names)


def _folder_of(names: Sequence[str], folder: Path) -> Path | None:
    """Return the folder of a set, or one directly in it, that holds photos under the exact names.

    Numbers such as 1.jpg may be names of several captures: the folder with most of the names and fewest others counts.
    The set's own folder comes first: folders in it may hold smaller copies of its photos.
    """
    places = [
        folder,
        *sorted(place for place in folder.iterdir() if place.is_dir() and place.name not in OTHER_FOLDERS),
    ]
    inner = [name.replace("\\", "/") for name in names]
    inner = [name for name in inner if not PurePosixPath(name).is_absolute() and ".." not in name]
    present = [sum((place / name).is_file() for name in inner) for place in places]
    fitting = [place for place, count in zip(places, present, strict=True) if count == max(present) > 0]
    return min(fitting, key=lambda place: (place != folder, len(list_images(place, PHOTO_SUFFIXES))), default=None)


def read_colmap(folder: Path, source: Path | None = None) -> DataparserOutputs:
    """Parse a COLMAP set: one record for each image of the model in `source`, in the natural order of the names."""
    source = source or find_model(folder, anywhere=True) or folder / "sparse"
    model = registered_model(source)
    names = [image.name for image in model.images[:LOOKED_FOR]]
    images, notes = _images_of_model(source, names, folder) or _folder_of(names, folder), []
    if images is None and (other := next((m for m in usual_models(folder) if image_folder(m.parent)), None)):
        place, used = source.relative_to(folder), other.relative_to(folder)  # As automatic_reconstructor leaves it
        notes.append(f"{place} has no photos; cameras are those of {used}, and photos lie beside it")
        source, model, images = other, registered_model(other), image_folder(other.parent)
    if images is None and source == folder:
        raise InputError(folder, "is a COLMAP model without photos", "give the folder that holds it and images/")
    if images is None:
        raise InputError(folder / "images", "folder not found", "put the photos that COLMAP used there")
    photos = find_images(images, [image.name for image in model.images], source)
    absent = sorted((name for name, photo in photos.items() if photo is None), key=natural_key)
    listed = source / "test.txt"  # Held-out images, as 3DGS lists them
    held_out = {line.strip() for line in read_lines(listed, "surrogateescape")} if has_file(listed) else set()
    records = []
    for entry in sorted(model.images, key=lambda image: natural_key(image.name)):
        if (photo := photos[entry.name]) is not None:
            image, hdr = photo_and_truth(photo)
            split = "test" if entry.name in held_out else "train" if held_out else None
            records.append(ImageRecord(image.stem, image, entry.lens, entry.world_to_camera, split=split, hdr=hdr))
    if not records:
        problem = f"none of the model's {len(absent)} images is here (the first is {absent[0]!r:.90})"
        others = unread_kinds(images)
        problem += f"; files of kinds that are not read: {others}" * bool(others)
        raise InputError(images, problem, IMAGES_REMEDY)
    records, repeated = distinct(records)
    unusable = unusable_notes(model.unusable, len(model.images) + len(model.unusable))
    notes += [*other_models(source), *unusable, *renamed_note(photos), *repeated]
    if absent:
        count = counted(
            len(absent), "image of the model is missing and was", "images of the model are missing and were"
        )
        notes.append(f"{count} left out: {absent[0]!r:.90}{' ...' * (len(absent) > 1)}")
    return DataparserOutputs("colmap", tuple(records), holdout=(8, 0), cloud=model.cloud, notes=tuple(notes))


def _images_of_model(source: Path, names: Sequence[str], folder: Path) -> Path | None:
    """Return the folder of images nearest above a model that holds one of the names, else the nearest, else None.

    Photos and undistorted copies may lie in one set: `images` belongs to `sparse`, `dense/images` to `dense/sparse`,
    and `input` to `distorted/sparse`.
    """
    if DISTORTED in source.relative_to(folder).parts and (folder / INPUT).is_dir():
        return folder / INPUT
    above = [place for place in source.parents if place.is_relative_to(folder)]
    places = [place for place in map(image_folder, dict.fromkeys((*above, folder))) if place is not None]
    holds = (place for place in places if any(find_image(place, name, source) for name in names))
    return next(holds, next(iter(places), None))


def registered_model(source: Path) -> SparseModel:
    """Read a model; raise InputError without registered images."""
    model = read_model(source)
    if not model.images and model.unusable:
        raise model.unusable[0]
    if not model.images:
        raise InputError(source, "the model has no registered views", "run structure from motion again")
    return model
