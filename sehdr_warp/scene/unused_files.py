"""Files beside the photos of a set that are not used: a few lines name them, so that nothing is lost unnoticed."""

import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from ..errors import InputError
from ..subsets import counted, first_names
from .dataparser import UNPLACED, ImageRecord
from .file_names import (
    GEOMETRY_FOLDERS,
    IMAGE_FOLDERS,
    INPUT,
    is_system_file,
    list_images,
    natural_key,
    without_mask_mark,
)
from .images.heif import HEIF_SUFFIXES, heif_installed
from .images.ldr_files import PHOTO_SUFFIXES
from .photo_names import bases_of, fold_name

# What tools write beside photos, and nobody takes for one.
_QUIET = {
    "", ".txt", ".md", ".rst", ".pdf", ".html", ".license", ".log", ".ini", ".db", ".json", ".csv", ".tsv", ".xml",
    ".yaml", ".yml", ".toml", ".xmp", ".pp3", ".dop", ".cos", ".thm", ".aae", ".lrv", ".wav", ".m4a", ".kml", ".gpx",
    ".geo", ".npy", ".npz", ".bin", ".ply", ".obj", ".mtl", ".pt", ".h5", ".pkl", ".psx", ".zip", ".tar", ".gz", ".py",
    ".sh", ".camera",
}  # fmt: skip
ARCHIVE_SUFFIXES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar")
_MOST_FILES = 20_000  # Files that are looked at


def unused_notes(folder: Path, records: Sequence[ImageRecord], mentioned: Collection[str]) -> list[str]:
    """Describe the files beside the photos that the set does not use.

    Args:
        folder: the data folder.
        records: all photos that the set uses or has left out with a note.
        mentioned: names of further photos that a note names.

    Returns:
        Notes on photos that are in no view, and on files of kinds that are not read.

    Raises:
        InputError: if the set states cameras of one or two photos, and more photos lie in their folder; or of fewer
            than ten, and more than ten times as many others lie there.
    """
    images = [record.image for record in records if not record.derived]
    if not images:
        return []
    files_in_use = {file for record in records for file in (record.image, record.mask, record.hdr)}
    files = list(_files_beside(images, folder))
    names = {name for file in files for name in (file.name, file.stem)}
    photos, others, broken = [], [], []
    for file in files:
        key = without_mask_mark(file.stem)
        if file in files_in_use or file.name in mentioned or (key != file.stem and key in names):
            continue
        suffix = file.suffix.lower()
        if not file.exists():
            broken.append(file)
        elif suffix in PHOTO_SUFFIXES:
            photos.append(file)
        elif suffix not in _QUIET:
            others.append(file)
    notes = []
    if photos:
        place = os.path.commonpath([file.parent for file in photos])
        where = Path(place).relative_to(folder).as_posix() if Path(place) != folder else "the folder"
        count = counted(len(photos), f"photo of {where} is", f"photos of {where} are")
        # Structure from motion before may have failed, if all photos lie in one folder.
        few = len(photos) > len(images) and {image.parent for image in images} == {Path(place)} != {folder}
        if few and (len(images) < 3 or len(photos) > 10 * len(images) < 100):
            problem = f"states the cameras of {len(images)} of {len(images) + len(photos)} photos"
            or_these = ", or move the others elsewhere" * (len(images) > 1)
            raise InputError(folder, problem, f"give {place} to find cameras of all{or_these}")
        remedy = f"; to find cameras of all photos anew, give {place}" * few
        notes.append(f"{count} in no view: {first_names([file.name for file in photos])}{remedy}")
    if records[0].lens is not UNPLACED:
        notes += _photos_apart(folder, images, files_in_use)
    if broken:
        links = counted(len(broken), "link leads", "links lead")
        notes.append(f"{links} to no file: {first_names([file.name for file in broken])}")
    if others:
        notes.append(f"not used, because files of these kinds are not read as photos: {_by_suffix(others)}")
    inside = (image.parent.parent for image in images if image.parent.is_relative_to(folder))
    above = {folder, *inside} - {folder.parent}
    geometry = sorted(place for each in above for place in each.iterdir() if place.name.lower() in GEOMETRY_FOLDERS)
    counts = [(place, len(list_images(place, PHOTO_SUFFIXES))) for place in geometry if place.is_dir()]
    if parts := [f"{place.relative_to(folder).as_posix()} ({count})" for place, count in counts if count]:
        notes.append(f"not used, because depth and normals come from the photos alone: pictures of {', '.join(parts)}")
    return notes


def _photos_apart(folder: Path, images: Sequence[Path], files_in_use: Collection[Path | None]) -> list[str]:
    """Describe photos in the folder itself and in 3DGS's `input/` of which no view is made, if all views lie elsewhere.

    3DGS's convert.py leaves all photos in `input/`, and copies those that were placed to `images/`.
    """
    views, notes = {fold_name(image.stem) for image in images}, []
    for place in (folder, folder / INPUT):
        if place.is_dir() and place not in {image.parent for image in images}:
            files = (file for file in list_images(place, PHOTO_SUFFIXES) if file not in files_in_use)
            apart = [file.name for file in files if fold_name(file.stem) not in views]
            if len(apart) > 1:  # A single one is a cover.
                remedy = f"; to find cameras of all anew, give {place}" * (place != folder)
                notes.append(f"{len(apart)} photos of {place.name} are in no view: {first_names(apart)}{remedy}")
    return notes


def unread_geometry(root: Path) -> list[str]:
    """Name files of a folder and of those in it that state geometry and are not read.

    They are K.txt (openMVG), *.jpg.camera (Strecha's benchmark) and gcp_list.txt (OpenDroneMap).
    """

    def names(*patterns: str) -> str:
        files = (file for name in patterns for place in ("", "*/") for file in sorted(root.glob(place + name)))
        return first_names([file.name for file in files])

    cameras, points = names("K.txt", "*.camera"), names("gcp_list.txt")
    notes = [f"files of cameras that are not read: {cameras}"] if cameras else []
    return [*notes, f"ground control points are not read: {points}; `view` can set scale and up"] if points else notes


def unread_kinds(folder: Path) -> str:
    """Describe the files of a folder that are of kinds that are not read; an empty text if there are none."""
    files = [file for file in sorted(folder.iterdir()) if file.is_file() and not file.name.startswith(".")]
    others = [f for f in files if f.suffix.lower() not in _QUIET and f.suffix.lower() not in PHOTO_SUFFIXES]
    return _by_suffix(others) if others else ""


def _by_suffix(files: Sequence[Path]) -> str:
    """Return counts by suffix, each with its first file, and what HEIC photos need."""
    kinds: dict[str, list[Path]] = {}
    for file in files:
        kinds.setdefault(file.suffix.lower().removeprefix(".").upper(), []).append(file)
    parts = [
        f"{len(each)} {kind} ({first_names([file.name for file in each], 1)})" for kind, each in sorted(kinds.items())
    ]
    needs = any(file.suffix.lower() in HEIF_SUFFIXES for file in files) and not heif_installed()
    return ", ".join(parts) + ("; HEIC photos need pillow-heif: pip install 'sehdr-warp[phone]'" if needs else "")


def _files_beside(images: Sequence[Path], folder: Path) -> Iterable[Path]:
    """Yield the files in the folders of the photos; all below `images/`, or their common folder in the data folder."""
    bases = bases_of(images, folder)
    common = next((base for base in bases[1:] if base.name in IMAGE_FOLDERS), bases[-1])
    deep = common != folder and common.is_relative_to(folder)
    places = [common] if deep else sorted({image.parent for image in images})
    count = 0
    for place in places:
        for root, folders, names in os.walk(place) if deep else [(place, [], os.listdir(place))]:
            folders[:] = [name for name in folders if not is_system_file(name)]
            for name in sorted(names, key=natural_key):
                count += 1
                if count > _MOST_FILES:
                    return
                file = Path(root) / name
                if not name.startswith(".") and (file.is_file() or (file.is_symlink() and not file.exists())):
                    yield file
