"""HDR truth of photos: which OpenEXR or Radiance file belongs to which photo."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..subsets import counted, first_names
from .dataparser import ImageRecord
from .file_names import folders_named
from .images.hdr_files import may_be_truth
from .images.ldr_files import HDR_SUFFIXES, LDR_SUFFIXES
from .photo_names import PhotoNames, fold_name

TRUTH_FOLDERS = ("hdr", "exr")


def assign_truth(records: Sequence[ImageRecord], folder: Path) -> tuple[list[ImageRecord], list[str]]:
    """Give each photo without truth the float picture that is named like it, in any layout.

    Truth lies beside the photo, or in `hdr/` or `exr/` of the data folder under a name of the photo (PhotoNames). Files
    of passes such as depth, which hold no colors, and views of a trained scene, as `render` writes them, are not truth.

    Args:
        records: the photos; truth that the set states itself stays.
        folder: the data folder.

    Returns:
        The photos with their truth, without float pictures that are the truth of others, and a note for each truth
        folder with files that are the truth of no photo.

    Raises:
        InputError: if truth is a link that leads out of the data folder.
    """
    photos = [record for record in records if _may_have_truth(record)]
    if not photos:
        return list(records), []
    photo_names = PhotoNames(photos, folder)
    places = folders_named(folder, TRUTH_FOLDERS)
    files = {place: _truth_by_name(place, "**/*") for place in places}
    beside = {parent: _truth_by_name(parent, "*") for parent in {record.image.parent for record in photos}}
    result = []
    for record in records:
        hdr = record.hdr
        if _may_have_truth(record):
            hdr = photo_names.file_of(record, files.values(), beside[record.image.parent])
            hdr = hdr if hdr is None or may_be_truth(hdr) else None
        result.append(replace(record, hdr=hdr))
    in_use, notes = {record.hdr for record in result}, []
    result = [record for record in result if record.is_own_truth or record.image not in in_use]
    for place in places:
        others = sorted(file.relative_to(place).as_posix() for file in files[place].values() if file not in in_use)
        if others:
            count = counted(len(others), "file that is", "files that are")
            rendered = sum(not may_be_truth(place / file) for file in others)
            passes = f" ({rendered} rendered by sehdr-warp, or without color)" * bool(rendered)
            notes.append(f"{place.name}/ holds {count} the truth of no photo{passes}: {first_names(others)}")
    return result, notes


def _may_have_truth(record: ImageRecord) -> bool:
    return record.hdr is None and not record.derived and record.image.suffix.lower() in LDR_SUFFIXES


def _truth_by_name(place: Path, pattern: str) -> dict[str, Path]:
    """Map the paths of float pictures below a folder, fold_name() and without suffix, to them; none without it."""
    files = [file for file in sorted(place.glob(pattern)) if file.suffix.lower() in HDR_SUFFIXES and file.is_file()]
    return {fold_name(file.relative_to(place).with_suffix("").as_posix()): file for file in reversed(files)}
