"""The names by which masks, truth and exposure times refer to photos: one rule for all of them.

A photo is named by its path below the data folder, or below a folder between that and all photos, or by its file name
alone if no two photos in their folders share that, used or not. The suffix may be left out; upper and lower case, and
the forms in which Unicode writes an accent, do not matter. Of several names the longest path counts.
"""

import os
import unicodedata
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

from ..files import resolve_inside
from .dataparser import ImageRecord
from .images.ldr_files import LDR_SUFFIXES


def fold_name(name: str) -> str:
    """Return a name in which upper and lower case, and the forms of an accent, are the same."""
    return unicodedata.normalize("NFC", name).casefold()


def photo_labels(images: Sequence[Path]) -> list[str]:
    """Return the file name of each photo, with its folder in front if the photos lie in several folders."""
    several = len({image.parent for image in images}) > 1
    return [f"{image.parent.name}/{image.name}" if several else image.name for image in images]


def bases_of(images: Sequence[Path], folder: Path) -> list[Path]:
    """List the folders that paths of photos may be relative to, from `folder` down to that of all photos."""
    common = Path(os.path.commonpath([image.parent for image in images]))
    return [*(place for place in reversed(common.parents) if place.is_relative_to(folder)), common]


def names_below(image: Path, bases: Iterable[Path]) -> list[str]:
    """List the paths of a photo below those of some folders that hold it, fold_name(), with and without suffix."""
    paths = [image.relative_to(base) for base in bases if image.is_relative_to(base)]
    return [fold_name(name) for path in paths for name in (path.as_posix(), path.with_suffix("").as_posix())]


class PhotoNames:
    """Names of the photos of a set.

    Attributes:
        bases: folders that paths may be relative to, see bases_of().
    """

    def __init__(self, records: Sequence[ImageRecord], folder: Path):
        """Prepare for at least one photo of a data folder."""
        self._records, self._folder = records, folder
        self.bases = bases_of([record.image for record in records], folder)

    def of(self, record: ImageRecord, *, by_view: bool = False) -> list[str]:
        """List the names of a photo, fold_name(), the most exact first.

        `by_view` adds those of its view, which several exposures share: `r_0`, and `train/r_0` of a split.
        """
        image, views, alone = record.image, [], [record.image.name, record.image.stem]
        if by_view:
            places = (base for base in self.bases if image.is_relative_to(base))
            views = [image.with_name(record.view).relative_to(place).as_posix() for place in places]
            views, alone = [*views, f"{record.split}/{record.view}"], [*alone, record.view]
        unique = (name for name in map(fold_name, alone) if len(self._alone[name]) == 1)
        return [*names_below(image, self.bases), *map(fold_name, views), *unique]

    @cached_property
    def _alone(self) -> dict[str, list[Path]]:
        """Map names and views alone, fold_name(), to the photos that have them, and to unused ones of other folders."""
        alone: dict[str, list[Path]] = {}
        for image, view in {(record.image, record.view): None for record in self._records}:
            for name in set(map(fold_name, (image.name, image.stem, view))):
                alone.setdefault(name, []).append(image)
        for parent in dict.fromkeys(record.image.parent for record in self._records):
            for file in (each for each in sorted(parent.glob("*")) if each.suffix.lower() in LDR_SUFFIXES):
                for photos in (alone.get(name, []) for name in {fold_name(file.name), fold_name(file.stem)}):
                    if photos and parent not in (photo.parent for photo in photos):
                        photos.append(file)
        return alone

    def sharing(self, name: str) -> list[Path]:
        """List the photos that have a file name, fold_name(), with suffix or without, if the set uses one of them."""
        return self._alone.get(name, [])

    def file_of(
        self, record: ImageRecord, tables: Iterable[dict[str, Path]], beside: dict[str, Path], *, by_view: bool = False
    ) -> Path | None:
        """Return the file that belongs to a photo, None if there is none.

        Args:
            record: the photo.
            tables: files of some folders, by what their names say, fold_name(); the first one counts.
            beside: files of the photo's own folder, likewise; they count after others.
            by_view: as in of().

        Raises:
            InputError: if the file is a link that leads out of the data folder.
        """
        near = beside, names_below(record.image, [record.image.parent])
        lookups = [*((table, self.of(record, by_view=by_view)) for table in tables), near]
        file = next((table[name] for table, names in lookups for name in names if name in table), None)
        return file and resolve_inside(self._folder, file.relative_to(self._folder).as_posix(), self._folder)
