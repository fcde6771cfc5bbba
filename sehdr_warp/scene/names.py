"""The order of file names, files beside each other, and names of views."""

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from .dataparser import ImageRecord


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


def without_mask_ending(stem: str) -> str:
    """Return a stem without the ending by which tools mark masks (`_mask`, `-mask`, `.mask`), if it has one."""
    return re.sub(r"(?<=.)[_.-]masks?$", "", stem, flags=re.IGNORECASE)


def list_images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """List the image files directly in a folder in natural order.

    Hidden files are left out, and masks beside their photo (`IMG_1_mask.png` beside `IMG_1.jpg`).
    """
    files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes and not file.name.startswith(".")]
    names = {name for file in files for name in (file.name, file.stem)}
    photos = (file for file in files if (key := without_mask_ending(file.stem)) == file.stem or key not in names)
    return sorted((file for file in photos if file.is_file()), key=lambda file: natural_key(file.name))


def unique_names(records: Sequence[ImageRecord]) -> list[str]:
    """Return a name for each photo that can name a file, unique without regard to case.

    It is the view's key. If two photos share one (`train/r_0` and `test/r_0`), a test view keeps it, and others get
    their folder in front (`train_r_0`) or a number behind.
    """
    plain = [re.sub(r"[^\w.+-]", "_", record.view) or "view" for record in records]
    counts = Counter(name.lower() for name in plain)
    shared = [counts[name.lower()] > 1 for name in plain]
    names, taken = {}, set()
    for i in sorted(range(len(records)), key=lambda i: (shared[i], records[i].split != "test")):
        base = f"{records[i].image.parent.name}_{plain[i]}" if shared[i] and records[i].split != "test" else plain[i]
        numbered = (f"{base}_{number}" if number > 1 else base for number in itertools.count(1))
        names[i] = next(name for name in numbered if name.lower() not in taken)
        taken.add(names[i].lower())
    return [names[i] for i in range(len(records))]
