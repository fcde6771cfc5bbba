"""Folders for what the program can make again, and the hash by which builds of the package differ."""

import hashlib
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


def cache_folder(path: Path | str | None = None) -> Path | None:
    """Return the folder of results: `path`, $SEHDR_CACHE or the user's; None if there is none."""
    folder = path or os.environ.get("SEHDR_CACHE")
    return user_cache("sehdr-warp") if folder is None else Path(folder)


def user_cache(name: str) -> Path | None:
    """Return the user's folder for what the program can make again; None if there is no home."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return None if home.startswith("~") else Path(home) / name


def package_hash() -> str:
    """Return eight hexadecimal digits of a hash over the package's code and presets, for versions of one name."""
    root, digest = Path(__file__).resolve().parent, hashlib.sha256()
    paths = (Path(folder, name) for folder, _, names in os.walk(root, followlinks=True) for name in names)
    for path in sorted(path for path in paths if path.suffix in (".py", ".toml")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:8]
