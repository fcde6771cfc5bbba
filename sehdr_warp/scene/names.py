"""The order of file names, files beside each other, and names of views."""

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from .capture import Shot


def natural_key(name: str) -> tuple:
    """Sorts img2 before img10."""
    return tuple((1, int(part), part) if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", name))


def view_and_exposure(stem: str) -> tuple[str, int | None]:
    """The view and the exposure's number of `<view>_<k>`; None for a name without one."""
    match = re.fullmatch(r"(.+)_(\d{1,3})", stem)
    return (match[1], int(match[2])) if match else (stem, None)


def sibling(path: Path, suffixes: tuple[str, ...]) -> Path | None:
    """The file of the same stem beside `path` with one of the suffixes in either case, or None."""
    candidates = (path.with_suffix(spelled) for suffix in suffixes for spelled in (suffix, suffix.upper()))
    try:
        return next((candidate for candidate in candidates if candidate.is_file()), None)
    except (OSError, ValueError):  # A name from a data file that no file can have.
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


def unique_names(shots: Sequence[Shot]) -> list[str]:
    """A name for each shot that can also name a file, unique without regard to case: the view's key. Where two share
    one (`train/r_0` and `test/r_0`), a test view keeps it, others have their folder before (`train_r_0`), or a number.
    """
    plain = [re.sub(r"[^\w.+-]", "_", shot.view) or "view" for shot in shots]
    counts = Counter(name.lower() for name in plain)
    shared = [counts[name.lower()] > 1 for name in plain]
    names, taken = {}, set()
    for i in sorted(range(len(shots)), key=lambda i: (shared[i], shots[i].split != "test")):
        base = f"{shots[i].image.parent.name}_{plain[i]}" if shared[i] and shots[i].split != "test" else plain[i]
        numbered = (f"{base}_{number}" if number > 1 else base for number in itertools.count(1))
        names[i] = next(name for name in numbered if name.lower() not in taken)
        taken.add(names[i].lower())
    return [names[i] for i in range(len(shots))]
