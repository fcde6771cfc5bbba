"""Folders for what the program can make again."""

import os
import tempfile
from pathlib import Path


def usable(folder: Path) -> bool:
    """Return whether files can be made in a folder, which is made if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except (OSError, ValueError):
        return False


def cache_folder(named: Path | str | None = None) -> Path | None:
    """Return the folder of results: the one that is named, $SEHDR_CACHE or the user's; None if there is none."""
    folder = named or os.environ.get("SEHDR_CACHE")
    return user_cache("sehdr-warp") if folder is None else Path(folder)


def user_cache(name: str) -> Path | None:
    """Return the user's folder for what the program can make again; None if there is no home."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return None if home.startswith("~") else Path(home) / name
