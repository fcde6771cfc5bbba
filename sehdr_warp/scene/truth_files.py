"""HDR truth of photos: which OpenEXR or Radiance file belongs to which photo."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from ..files import resolve_inside
from ..subsets import first_names
from .dataparser import ImageRecord
from .file_names import bases_of, fold_name, folders_named
from .hdr_files import is_without_colors
from .images import HDR_SUFFIXES, LDR_SUFFIXES

TRUTH_FOLDERS = ("hdr", "exr")
_MOST_FILES = 1 << 20  # Files among which photos of one name are looked for


def assign_truth(records: Sequence[ImageRecord], folder: Path) -> tuple[list[ImageRecord], list[str]]:
    """Give each photo without truth the float picture that is named like it, in any layout.

    Truth lies beside the photo, or in `hdr/` or `exr/` of the data folder under the photo's path below the data folder
    or below the folder of all photos, or under its file name alone if no two photos share that. Files of
    passes such as depth, which hold no colors, are not truth.

    Args:
        records: the photos; truth that the set states itself stays.
        folder: the data folder.

    Returns:
        The photos with their truth, without float pictures that are the truth of others, and a note for each truth
        folder with files that are the truth of no photo.

    Raises:
        InputError: if truth, or its folder, is a link that leads out of the folder that holds it.
    """
    photos = [record for record in records if _may_have_truth(record)]
    if not photos:
        return list(records), []
    bases = bases_of([record.image for record in photos], folder)
    places = folders_named(folder, TRUTH_FOLDERS)
    files = {
        place: {_key(file.relative_to(place)): file for file in sorted(place.rglob("*")) if _is_float(file)}
        for place in places
    }
    stems = _stems_below(bases[0]) if places else Counter()
    beside = {parent: _beside(parent) for parent in {record.image.parent for record in photos}}
    result = []
    for record in records:
        image, hdr = record.image, record.hdr
        if _may_have_truth(record):
            keys = [_key(image.relative_to(base)) for base in bases if image.is_relative_to(base)]
            keys += [fold_name(image.stem)] * (stems[fold_name(image.stem)] <= 1)
            candidates = ((place, files[place].get(key)) for key in keys for place in places)
            near = image.parent, beside[image.parent].get(fold_name(image.stem))
            names = ((place, file.relative_to(place).as_posix()) for place, file in (*candidates, near) if file)
            hdr = next((resolve_inside(place, name, folder) for place, name in names), None)
            hdr = None if hdr is not None and is_without_colors(hdr) else hdr
        result.append(replace(record, hdr=hdr))
    in_use, notes = {record.hdr for record in result}, []
    result = [record for record in result if record.is_own_truth or record.image not in in_use]
    for place in places:
        others = sorted(file.relative_to(place).as_posix() for file in files[place].values() if file not in in_use)
        if others:
            listing = first_names(others)
            count = f"{len(others)} files that are" if len(others) > 1 else "1 file that is"
            notes.append(f"{place.name}/ holds {count} the truth of no photo: {listing}")
    return result, notes


def _may_have_truth(record: ImageRecord) -> bool:
    return record.hdr is None and not record.derived and record.image.suffix.lower() in LDR_SUFFIXES


def _beside(parent: Path) -> dict[str, Path]:
    """Map fold_name() stems to the float pictures of a folder."""
    if not parent.is_dir():
        return {}
    return {fold_name(file.stem): file for file in sorted(parent.iterdir(), reverse=True) if _is_float(file)}


def _is_float(file: Path) -> bool:
    return file.suffix.lower() in HDR_SUFFIXES and file.is_file()


def _stems_below(folder: Path) -> Counter:
    """Count the fold_name() stems of the photos below a folder."""
    names = (Path(name) for _, _, files in os.walk(folder) for name in files)
    return Counter(fold_name(name.stem) for name in islice(names, _MOST_FILES) if name.suffix.lower() in LDR_SUFFIXES)


def _key(path: Path) -> str:
    """Return a relative path without suffix, fold_name()."""
    return fold_name(path.with_suffix("").as_posix())
