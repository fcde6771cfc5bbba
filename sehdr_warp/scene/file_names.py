"""The order of file names, files beside each other, and names of views."""

import itertools
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from ..files import resolve_inside
from ..subsets import counted, first_names
from .dataparser import ImageRecord
from .images.ldr_files import HDR_SUFFIXES, LDR_SUFFIXES, PHOTO_SUFFIXES
from .photo_names import fold_name

MASK_FOLDERS = ("masks", "mask", "images_mask")  # Folders of masks of a set, in any case
OTHER_FOLDERS = (*MASK_FOLDERS, "hdr", "exr")  # Folders of pictures that are not photos
GEOMETRY_FOLDERS = ("depth", "depths", "confidence", "normals")  # Folders of pictures that nothing reads
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8")
"""Folders of photos, from the full size to reduced copies."""
INPUT = "input"  # Folder of photos of 3DGS's convert.py, which writes undistorted copies to images/
LOOKED_FOR = 20  # Images of a set by whose names their folder is found
INVERTED_MASK = "dynamic_mask_"
"""Beginning of the names of instant-ngp's masks, in which 0 keeps a pixel and every other value leaves it out."""
_FORBIDDEN = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|]')  # Separators, what Windows forbids, and control characters
_LONGEST = 120  # Bytes of a name, which get prefixes and suffixes; most file systems take 255


def natural_key(name: str) -> tuple:
    """Return a sort key that puts img2 before img10."""
    return tuple((1, int(part), part) if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", name))


def view_and_exposure(stem: str) -> tuple[str, int | None]:
    """Split `<view>_<k>` into the view and the exposure's number, which is None for a name without one."""
    match = re.fullmatch(r"(.+)_(\d{1,3})", stem)
    return (match[1], int(match[2])) if match else (stem, None)


def sibling(path: Path, suffixes: tuple[str, ...]) -> Path | None:
    """Return the file beside `path` with the same stem and one of the suffixes in either case, or None."""
    candidates = (path.with_suffix(spelled) for suffix in suffixes for spelled in (suffix, suffix.upper()))
    try:
        return next((candidate for candidate in candidates if candidate.is_file()), None)
    except (OSError, ValueError):  # A name from a data file that is not possible as a file name.
        return None


def photo_and_truth(image: Path) -> tuple[Path, Path | None]:
    """Return the photo beside a float picture, and the picture as its truth; any other image without truth."""
    photo = sibling(image, LDR_SUFFIXES) if image.suffix.lower() in HDR_SUFFIXES else None
    return (image, None) if photo is None else (photo, image)


def image_folder(folder: Path) -> Path | None:
    """Return the folder of images, at full size if possible, or None."""
    return next((folder / name for name in IMAGE_FOLDERS if (folder / name).is_dir()), None)


def folders_named(folder: Path, names: Sequence[str]) -> list[Path]:
    """List the folders in a folder that have some names, in any case, in the order of the names; none without it."""
    if not folder.is_dir():
        return []
    places = [place for place in sorted(folder.iterdir()) if place.name.lower() in names and place.is_dir()]
    places = [resolve_inside(folder, place.name, folder) for place in places]
    return sorted(places, key=lambda place: names.index(place.name.lower()))


def lies_at(path: str) -> bool:
    """Return whether a path, or one with a suffix of photos behind it, is a file; case and accents do not matter."""
    folder, name = os.path.split(path)
    names, folded = _entries(Path(folder)), fold_name(name)
    spellings = (names.get(folded + suffix) for suffix in ("", *PHOTO_SUFFIXES))
    return any(os.path.isfile(os.path.join(folder, each)) for each in spellings if each is not None)


def without_mask_mark(stem: str) -> str:
    """Return a stem, or a path without suffix, without the mark of masks.

    Marks are `mask_` or `dynamic_mask_` before it, and `_mask` or remove.bg's `-removebg-preview` behind it.
    """
    marks = r"(^|(?<=/))(dynamic_)?mask[_-](?=.)|(?<=.)([_.-]masks?|-removebg(-preview)?)$"
    return re.sub(marks, "", stem, flags=re.IGNORECASE)


def find_image(folder: Path, name: str, source: Path) -> Path | None:
    """Return the image of a name that a data file states, None if it is not there.

    Names written on Windows have backslashes, those of web addresses %20 for spaces, and names that are not UTF-8 are
    tried as Latin-1 too. A photo with another suffix, as after a conversion, is found by its stem. An absolute name, or
    one that begins with `..`, as of a set that was copied, stands for the file in the folder that its last parts name.
    Upper and lower case, and the forms in which Unicode writes an accent, count as equal if no file has the exact name.

    Args:
        folder: of the images.
        name: as stated; bytes that are not UTF-8 are surrogates, as in names of files.
        source: the data file.

    Raises:
        InputError: if the name has `..` after its beginning, or leads out of the folder by a link.
    """
    names = dict.fromkeys((name, name.replace("\\", "/")))
    with suppress(UnicodeError):
        latin = os.fsencode(name).decode("latin-1")
        names |= dict.fromkeys((latin, latin.replace("\\", "/")))
    with suppress(UnicodeError):
        names |= {os.fsdecode(name.encode("latin-1")): None}
    if inner := _inside(folder, name, source):
        names = {inner: None}
    elif (PureWindowsPath(name).anchor or PureWindowsPath(name).parts[:1] == ("..",)) and "\0" not in name:
        return None
    places = [resolve_inside(folder, each, source) for each in names]
    image = next((place for place in places if os.path.isfile(place)), None)
    image = image or next((photo for each in names if (photo := _alike(folder, each, source))), None)
    plain = unquote(name)
    return image if image or plain == name else find_image(folder, plain, source)


def find_images(folder: Path, names: Sequence[str], source: Path) -> dict[str, Path | None]:
    """Return the image of each name as find_image(); if none is there, those of their file names in an inner folder.

    Tools sort photos into folders by camera, or out of them, and 3DGS looks for file names alone.
    """
    images = {name: find_image(folder, name, source) for name in names}
    files = {name: PureWindowsPath(name).name for name in names}
    if any(images.values()) or len(set(files.values())) < len(files):
        return images
    first = list(files.values())[:LOOKED_FOR]
    inner = (place for pattern in ("*/", "*/*/", "*/*/*/") for place in sorted(folder.glob(pattern)))
    for place in (folder, *inner):
        # A link must not lead out of the set.
        if place.name in OTHER_FOLDERS or not place.resolve().is_relative_to(folder.resolve()):
            continue
        if any(find_image(place, file, source) for file in first):
            return {name: find_image(place, file, source) for name, file in files.items()}
    return images


def _inside(folder: Path, name: str, source: Path) -> str | None:
    """Return the longest end of an absolute name that is a photo in the folder, None if there is none."""
    path = PureWindowsPath(name)
    parts = path.parts
    above = next((number for number, part in enumerate(parts) if part != ".."), len(parts))
    if not (path.anchor or above) or "\0" in name or ".." in parts[above:]:
        return None
    ends = ("/".join(parts[start:]) for start in range(max(above, 1), len(parts)))
    return next((end for end in ends if _alike(folder, end, source)), None)


def _alike(folder: Path, name: str, source: Path) -> Path | None:
    """Return the photo whose path below a folder differs from a name by case or the form of accents alone.

    The suffix may be that of another kind of photo, and the name may begin with the name of the folder itself.
    """
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if not parts:
        return None
    if len(parts) > 1 and fold_name(parts[0]) == fold_name(folder.name):
        return find_image(folder, "/".join(parts[1:]), source)
    place = folder
    for part in parts[:-1]:
        names = _entries(place)
        if fold_name(part) not in names:
            return None
        place /= names[fold_name(part)]
    names = _entries(place)
    stem = PureWindowsPath(parts[-1]).stem
    # A name may have no suffix, and a dot all the same.
    stems = fold_name(parts[-1]), fold_name(stem)
    endings = dict.fromkeys((stems[0], *(each + suffix for each in stems for suffix in PHOTO_SUFFIXES)))
    match = next((names[ending] for ending in endings if ending in names), None)
    photo = None if match is None else resolve_inside(folder, (place / match).relative_to(folder).as_posix(), source)
    return photo if photo is not None and os.path.isfile(photo) else None


def plain_path(name: str) -> str:
    """Return a path without a leading `./` and with forward slashes."""
    return re.sub(r"^(\./)+", "", name.replace("\\", "/"))


def _entries(folder: Path) -> Mapping[str, str]:
    """Return the names in a folder by their folded form; empty if it cannot be read."""
    try:
        return _entries_at(folder, folder.stat().st_mtime_ns)
    except (OSError, ValueError):  # Also of a name that cannot be.
        return {}


@lru_cache(maxsize=64)
def _entries_at(folder: Path, changed: int) -> Mapping[str, str]:
    """Return _entries(); `changed` is when the folder changed."""
    return {fold_name(name): name for name in sorted(os.listdir(folder), reverse=True)}


def distinct(records: Sequence[ImageRecord]) -> tuple[list[ImageRecord], list[str]]:
    """Return records without those of a split whose photo another one has already, and a note on these."""
    keys, unique, names = set(), [], []
    for record in records:
        key = record.split, record.image, record.exposure_key
        if key in keys:
            names.append(record.image.name)
        else:
            unique.append(record)
        keys.add(key)
    if not names:
        return unique, []
    count = counted(len(names), "photo is", "photos are")
    return unique, [f"{count} listed more than once, and counted once: {first_names(names)}"]


def renamed_note(images: Mapping[str, Path | None]) -> list[str]:
    """Return a note on photos under another suffix than their names, which are the keys, have."""
    suffixes = {name: PureWindowsPath(name).suffix.lower() for name in images}
    others = [
        (PureWindowsPath(name).name, photo.name)
        for name, photo in images.items()
        if photo is not None and suffixes[name] in PHOTO_SUFFIXES and suffixes[name] != photo.suffix.lower()
    ]
    if not others:
        return []
    count = counted(len(others), "photo has", "photos have")
    return [f"{count} another suffix than the set states: {others[0][0]} is {others[0][1]}"]


def list_images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """List the image files directly in a folder in natural order.

    Hidden files are left out, and masks beside their photo (`IMG_1_mask.png` beside `IMG_1.jpg`).
    """
    files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes and not file.name.startswith(".")]
    names = {name for file in files for name in (file.name, file.stem)}
    photos = (file for file in files if (key := without_mask_mark(file.stem)) == file.stem or key not in names)
    return sorted((file for file in photos if file.is_file()), key=lambda file: natural_key(file.name))


def is_system_file(folder: str) -> bool:
    """Return whether a folder's name is one that systems and network storage use for copies and thumbnails."""
    return folder.startswith((".", "@", "#", "$")) or folder == "__MACOSX"


def _plain(name: str) -> str:
    """Return a name in letters, digits and marks that need no quotes."""
    return re.sub(r"[^\w.+-]", "_", name) or "view"


def view_names_of(file_name: str) -> list[str]:
    """Return the names that a view may have by the file name of its photo, likeliest first, with or without suffix."""
    path = Path(file_name)
    stem, folder = path.stem if path.suffix.lower() in PHOTO_SUFFIXES else path.name, path.parent.name
    names = [_plain(unicodedata.normalize(form, stem)) for form in ("NFC", "NFD")]
    return [f"{folder}_{name}" for name in names if folder] + names  # As of unique_names()


def unique_names(records: Sequence[ImageRecord]) -> list[str]:
    """Return a name for each photo that can name a file, unique without regard to case.

    It is the view's key. If two photos share one (`train/r_0` and `test/r_0`), a test view keeps it, and others get
    their folder in front (`train_r_0`) or a number behind.
    """
    plain = [_plain(record.view) for record in records]
    counts = Counter(name.lower() for name in plain)
    shared = [counts[name.lower()] > 1 for name in plain]
    names, reserved = {}, set()
    for i in sorted(range(len(records)), key=lambda i: (shared[i], records[i].split != "test")):
        base = f"{records[i].image.parent.name}_{plain[i]}" if shared[i] and records[i].split != "test" else plain[i]
        numbered = (f"{base}_{number}" if number > 1 else base for number in itertools.count(1))
        names[i] = next(name for name in numbered if name.lower() not in reserved)
        reserved.add(names[i].lower())
    return [names[i] for i in range(len(records))]


def safe_names(names: Sequence[str]) -> list[str]:
    """Return file names for views that are all different, also on systems that ignore case.

    Letters that some system forbids become `_`, leading dots are dropped, names are cut at 120 bytes, and repeated
    names get a number.
    """
    cleaned = [_FORBIDDEN.sub("_", name).strip().lstrip(".").encode("utf-8")[:_LONGEST] for name in names]
    cleaned = [name.decode("utf-8", "ignore").rstrip(". ") or "view" for name in cleaned]
    folded, result = {name.casefold() for name in cleaned}, {}
    for name in cleaned:
        numbered = (f"{name}_{number}" for number in itertools.count(2))
        free = (each for each in numbered if (low := each.casefold()) not in folded and low not in result)
        unique = next(free) if name.casefold() in result else name
        result[unique.casefold()] = unique
    return [*result.values()]
