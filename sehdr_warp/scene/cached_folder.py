"""Folders of results that take long to compute: structure from motion, and the frames of a video."""

import hashlib
import logging
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from ..caches import cache_folder, usable
from ..errors import InputError, SehdrError
from ..files import atomic_folder
from ..own_files import is_as_listed

_log = logging.getLogger("sehdr_warp.scene")
_temporaries: list[tempfile.TemporaryDirectory] = []


def cached_folder(cache: Path | str | None, name: str, what: str, fill: Callable[[Path], None]) -> Path:
    """Return the folder of a result: the cached one, or a new one that fill(folder) writes.

    The user's cache is $SEHDR_CACHE, or sehdr-warp/ in $XDG_CACHE_HOME or ~/.cache. If it cannot be written, the result
    is in a temporary folder of this process. A damaged result is computed again.

    Args:
        cache: The cache, which must be writable; None for the user's.
        name: Name of the result, which contains a hash of everything that it depends on.
        what: What the result is, for the user.
        fill: Computes the result and writes its files.
    """
    folder = cache_folder(cache)
    place = (folder or Path()) / name
    if folder and place.is_dir():
        if is_as_listed(place):
            _log.info("%s: using the cached result %s", what, place)
            return place
        _log.warning("%s is damaged and is made again", place)
        shutil.rmtree(place, ignore_errors=True)
    if cache is None and not (folder and usable(folder) and not place.exists()):
        _temporaries.append(tempfile.TemporaryDirectory(prefix="sehdr-"))
        place = Path(_temporaries[-1].name) / name
    try:
        with atomic_folder(place) as result:
            fill(result)
    except SehdrError:
        if not (place.is_dir() and is_as_listed(place)):  # Else another process was first; its result is used.
            raise
    return place


def file_digest(path: Path) -> str:
    """Return a hash of a file's content, or raise InputError if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error})", "check its permissions") from None
