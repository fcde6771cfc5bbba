"""Masks: which mask file belongs to which photo, and what its values mean."""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import InputError
from ..files import resolve_inside
from ..subsets import counted, first_names
from .dataparser import UNPLACED, ImageRecord
from .file_names import INVERTED_MASK, MASK_FOLDERS, folders_named, lies_at, natural_key, without_mask_mark
from .images.ldr_files import JPEG_SUFFIXES, LDR_SUFFIXES, PILLOW_ERRORS, open_image, read_ldr
from .photo_names import PhotoNames, fold_name
from .photos import photo_sizes

_OTHER_MASKS = (".gif", ".npy", ".npz", ".exr", ".json", ".svg")
_COMMON = ("mask", "camera_mask")  # Stems of a mask of all photos
_BLACK_AND_WHITE = 0.9  # Part of such a mask that has these values
_MOST_LABELS = 31  # Larger values are weights relative to white
_MATERIAL = 0.5  # Range of alpha that is a mask beside color that varies, too
_REMEDY = "name each like its photo, such as masks/IMG_1.png or masks/IMG_1.jpg.png"


def assign_masks(records: Sequence[ImageRecord], folder: Path) -> tuple[list[ImageRecord], list[str]]:
    """Give each photo without a mask the mask file that is named like it, in any layout.

    Masks lie in a folder of MASK_FOLDERS in the data folder, with any picture suffix behind a name of the photo or of
    its view (PhotoNames), such as `masks/cam0/1.jpg.png` or `masks/cam0/1.png`. without_mask_mark() says which marks
    of the stem are ignored. Files with such a mark beside the photos are masks as well, and so are those of a folder of
    MASK_FOLDERS there.
    `mask.png` or `camera_mask.png` of the data folder, or of the only folder of photos, is the mask of all photos of
    its shape that have none of their own, as of a tripod or a car's bonnet.

    Args:
        records: the photos; a mask that the set states itself stays.
        folder: the data folder.

    Returns:
        The photos with their masks, and a note for each mask folder with files that fit no photo, or whose name is
        not read.

    Raises:
        InputError: if a mask is a link that leads out of the data folder.
    """
    photo_names = PhotoNames(records, folder)
    places = folders_named(folder, MASK_FOLDERS)
    files = {place: {file: _key(file, place) for file in _files_below(place)} for place in places}
    tables = [{fold_name(key): file for file, key in reversed(keys.items())} for keys in files.values()]
    beside = {parent: _masks_beside(parent) for parent in {record.image.parent for record in records}}
    common = _common_mask(folder, records)
    masked, mask_files = [], set()
    for record in records:
        near = beside[record.image.parent]
        mask = record.mask or photo_names.file_of(record, tables, near, by_view=True)
        if mask is None and common is not None and _has_shape(common[1], record):
            mask = common[0]
        mask_files.add(mask)
        masked.append(replace(record, mask=mask))
    notes = []
    for place, keys in files.items():
        # A mask of a photo that the set leaves out is named with that photo, not here.
        strange = [
            file
            for file, key in keys.items()
            if file not in mask_files and not any(lies_at(f"{base}/{key}") for base in photo_names.bases)
        ]
        names = [file.relative_to(place).as_posix() for file in strange]
        if names:
            count = counted(len(names), "file that fits", "files that fit")
            notes.append(f"{place.name}/ holds {count} no photo: {first_names(names)}; {_REMEDY}")
    used = {place for mask in mask_files if mask is not None for place in mask.parents}
    return masked, [*notes, *_unread_masks(folder, places, used)]


def read_mask(path: Path, *, oriented: bool = False, labeled: set[Path] | None = None) -> np.ndarray:
    """Read a mask of grey, of color (its mean) or of transparency (its alpha) values.

    Transparency counts if it varies by more than half, or if the color is the same everywhere.

    Masks of two values, one of which is 0, count as COLMAP counts them: every value above 0 keeps the pixel. This
    covers 0 and 1, label colors and palettes. So do masks of labels, such as 0, 1 and 2, whose values are at most 31
    and which are stored without loss. Others are weights relative to white. Files whose names begin with INVERTED_MASK
    leave out every pixel above 0.

    Args:
        path: the file.
        oriented: turn the pixels as the EXIF orientation says.
        labeled: set to which a mask of several labels is added.

    Returns:
        [H, W] float32 in [0, 1]; 1 keeps the pixel.

    Raises:
        InputError: as read_ldr raises it.
    """
    image = read_ldr(path, oriented=oriented, mask=True)
    if path.name.lower().startswith(INVERTED_MASK):
        return (image.pixels == 0).all(axis=2).astype(np.float32)
    # A few pixels that are not quite opaque do not make alpha the mask.
    if image.alpha is not None and (np.ptp(image.alpha) > _MATERIAL or (image.pixels == image.pixels[0, 0]).all()):
        values = image.alpha * np.float32(image.levels)
    else:
        values = image.pixels.mean(axis=2, dtype=np.float32)
    largest, two = float(values.max()), (values == 0) | (values == values.max())
    if largest <= 1 or (float(values.min()) == 0 and two.all()):
        return (values > 0).astype(np.float32)
    lossy = path.suffix.lower() in JPEG_SUFFIXES  # Its dark pixels may be noise.
    if largest <= _MOST_LABELS and float(values.min()) < largest and not lossy:
        if labeled is not None:
            labeled.add(path)
        return (values > 0).astype(np.float32)
    white = 255 if largest <= 255 else image.levels  # Also of 8-bit values in a 16-bit file.
    return values / np.float32(white)


def write_reduced(mask: Path | None, size: tuple[int, int], file: Path) -> None:
    """Write a mask at the size of a photo's copy, white where it keeps a pixel; all white if it is None or damaged."""
    weights = np.ones((1, 1), np.float32)
    with suppress(InputError):  # Named when the photos are read for the training.
        weights = weights if mask is None else read_mask(mask, oriented=True)
    reduced = np.asarray(Image.fromarray(weights).resize(size, Image.Resampling.BOX))
    Image.fromarray(np.uint8(255) * (reduced >= 0.5)).save(file)


def mask_note(shares: Sequence[float | None], labeled: int = 0) -> list[str]:
    """Describe how many photos have a mask and what share of their pixels is left out: one line, or none without masks.

    `shares` has the mean of each photo's mask, None for a photo without one. `labeled` of the masks hold labels, which
    a second line says.
    """
    masked = [share for share in shares if share is not None]
    if not masked:
        return []
    out = 100 * (1 - sum(masked) / len(masked))
    lines = [f"masks: {len(masked)} of {len(shares)} photos have one; they leave out {out:.1f} % of their pixels"]
    if labeled:
        lines.append(f"masks: {labeled} hold labels up to {_MOST_LABELS}; every label above 0 keeps its pixels")
    return lines


def _common_mask(folder: Path, records: Sequence[ImageRecord]) -> tuple[Path, tuple[int, int]] | None:
    """Return the mask of all photos and its (width, height); None without one, or if it is one of the photos."""
    parents = {record.image.parent for record in records}
    places = [folder, *(place for place in parents if len(parents) == 1 and place.is_relative_to(folder))]
    files = (place / f"{stem}{suffix}" for place in places for stem in _COMMON for suffix in LDR_SUFFIXES)
    candidates = (file for file in files if file.is_file() and (file.parent == folder or is_common_mask(file)))
    if (file := next(candidates, None)) is None or any(record.image == file for record in records):
        return None
    with open_image(resolve_inside(folder, file.relative_to(folder).as_posix(), folder), mask=True) as image:
        return file, image.size


def is_common_mask(file: Path) -> bool:
    """Return whether a file among photos is the mask of all: it has that name, and is black and white."""
    if file.stem not in _COMMON or file.suffix.lower() not in LDR_SUFFIXES:
        return False
    try:
        with open_image(file, mask=True) as image:
            codes = np.asarray(image.convert("L"))
            return bool(((codes < 8) | (codes > 247)).mean() > _BLACK_AND_WHITE)
    except (InputError, *PILLOW_ERRORS):
        return False


def _has_shape(size: tuple[int, int], record: ImageRecord) -> bool:
    """Return whether a size has the shape of a photo."""
    width, height = record.lens.width, record.lens.height
    if record.lens is UNPLACED:
        try:
            stored, upright = photo_sizes(record.image)
        except InputError:
            return False  # The readers of this photo report what is wrong with it.
        width, height = upright if record.oriented else stored
    return abs(size[0] * height - size[1] * width) <= max(size)


def _key(mask: Path, place: Path) -> str:
    """Return the path of a mask below its folder, without its suffix and an ending that only says what it is."""
    return without_mask_mark(mask.relative_to(place).with_suffix("").as_posix())


def _files_below(place: Path) -> list[Path]:
    files = (file for file in place.rglob("*") if file.suffix.lower() in LDR_SUFFIXES and not file.name.startswith("."))
    return sorted((file for file in files if file.is_file()), key=lambda file: natural_key(file.as_posix()))


def _masks_beside(parent: Path) -> dict[str, Path]:
    """Map fold_name() names or stems of photos to the masks in the photos' own folder, or in a mask folder there."""
    if not parent.is_dir():
        return {}
    files = (file for file in parent.iterdir() if file.suffix.lower() in LDR_SUFFIXES)
    masks = {fold_name(key): file for file in files if (key := without_mask_mark(file.stem)) != file.stem}
    inner = (
        file for place in folders_named(parent, MASK_FOLDERS) for file in _files_below(place) if file.parent == place
    )
    return {fold_name(without_mask_mark(file.stem)): file for file in inner} | masks


def _unread_masks(folder: Path, places: Sequence[Path], used: set[Path]) -> list[str]:
    """Return notes on folders that look like masks and are not read, and on files in mask folders of other kinds.

    Args:
        folder: the data folder.
        places: its folders of masks.
        used: folders of the masks that photos have.
    """
    notes = []
    for place in places:
        others = sorted(file for file in place.rglob("*") if file.suffix.lower() in _OTHER_MASKS)
        if others:
            names_text = first_names([file.name for file in others])
            count = counted(len(others), "file", "files")
            notes.append(f"{place.name}/ holds {count} of kinds that are not read as masks: {names_text}; use PNG")
    if not folder.is_dir():
        return notes
    # nerfstudio writes masks_2, masks_4, ... beside masks.
    looks = r"(?!masks_\d+$).*(mask|segment|matte|alpha)" if places else r".*(mask|segment|matte|alpha)"
    for place in sorted(folder.iterdir()):
        if place in places or place in used or not re.match(looks, place.name, re.IGNORECASE):
            continue
        if place.is_dir() and not place.is_symlink() and _files_below(place):
            notes.append(f"{place.name}/ is not read: if it holds masks of the photos, name it masks/")
    return notes
