"""The order of file names, files beside each other, and names of views."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from .capture import Shot


def natural_key(name: str) -> tuple:
    """Sorts img2 before img10."""
    return tuple((1, int(part), part) if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", name))


def sibling(path: Path, suffixes: tuple[str, ...]) -> Path | None:
    """The file of the same stem beside `path` with one of the suffixes in either case, or None."""
    for suffix in suffixes:
        for candidate in (path.with_suffix(suffix), path.with_suffix(suffix.upper())):
            try:
                if candidate.is_file():
                    return candidate
            except (OSError, ValueError):  # A name from a data file that no file can have.
                return None
    return None


def list_images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """The image files directly in a folder, hidden ones left out, in natural order."""
    files = (file for file in folder.iterdir() if file.suffix.lower() in suffixes and not file.name.startswith("."))
    return sorted((file for file in files if file.is_file()), key=lambda file: natural_key(file.name))


def unique_names(shots: Sequence[Shot]) -> list[str]:
    """A name for each shot that can also name a file, unique without regard to case.

    It is the view's key. Where two shots share one (`train/r_0` and `test/r_0`), a test view keeps it, and the others
    are called after their folder (`train_r_0`), then numbered.
    """
    plain = [re.sub(r"[^\w.+-]", "_", shot.view) or "view" for shot in shots]
    counts = Counter(name.lower() for name in plain)
    names: list[str | None] = [name if counts[name.lower()] == 1 else None for name in plain]
    taken = {name.lower() for name in names if name}
    for wants_plain in (True, False):
        for i, shot in enumerate(shots):
            if names[i] is not None or (wants_plain and shot.split != "test"):
                continue
            base = plain[i] if wants_plain else f"{shot.image.parent.name}_{plain[i]}"
            name, number = base, 2
            while name.lower() in taken:
                name, number = f"{base}_{number}", number + 1
            names[i] = name
            taken.add(name.lower())
    return names
