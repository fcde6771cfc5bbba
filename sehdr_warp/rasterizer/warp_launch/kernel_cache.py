"""Warp's cache of compiled kernels: a folder that can be written to, and files in it that are as they were compiled.

Warp loads what it finds there, and a damaged object ends the process that does. A file of the cache is never changed
once it has its name, so their hashes are kept, and a module with another one is compiled again.
"""

import atexit
import logging
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import warp as wp

from ...caches import usable, user_cache
from ...errors import SehdrError
from ...files import atomic_path
from ...own_files import LIST, hash_line, read_list

_log = logging.getLogger("sehdr_warp.rasterizer")
# Named by their content; neither what is being compiled nor what Warp compiles anew in its place.
_MODULE = re.compile(r"wp_.*_[0-9a-f]{7}")


def select_folder() -> None:
    """Give Warp a cache folder that can be written to; called before wp.init()."""
    configured = os.environ.get("WARP_CACHE_PATH")
    if wp.config.kernel_cache_dir or (configured is None and not sys.platform.startswith("linux")):
        return
    folder = user_cache("warp") if configured is None else Path(configured)
    if folder is None or not usable(folder):
        wp.config.kernel_cache_dir = tempfile.mkdtemp(prefix="sehdr-kernels-")
        atexit.register(shutil.rmtree, wp.config.kernel_cache_dir, ignore_errors=True)
        _log.warning("%s cannot be written to; kernels are compiled for this process alone", folder or "~/.cache")


def discard_damaged() -> None:
    """Discard damaged modules; call it after wp.init(), before the first launch."""
    cache = Path(wp.config.kernel_cache_dir or "")
    now, before = _lines(cache), read_list(cache)
    names = {line[66:] for line in now}
    damaged = {os.fsdecode(line[66:]).partition("/")[0] for line in before - now if line[66:] in names}
    for module in damaged:
        shutil.rmtree(cache / module, ignore_errors=True)
    if damaged:
        _log.warning("%d damaged modules of the kernel cache are compiled again", len(damaged))
    if damaged or now != before:
        _keep(cache)
    atexit.register(_keep_changes, cache, _states(cache))


def _files(cache: Path) -> Iterator[Path]:
    """Yield the files of the modules, while other processes may be at work there."""
    for module in (path for path in cache.glob("wp_*") if _MODULE.fullmatch(path.name)):
        with suppress(OSError):
            yield from module.iterdir()


def _states(cache: Path) -> set[tuple[Path, int, int]]:
    """Return size and time of each file, by which a change shows without reading what it holds."""
    states = set()
    for file in _files(cache):
        with suppress(OSError):
            state = file.stat()
            states.add((file, state.st_size, state.st_mtime_ns))
    return states


def _lines(cache: Path) -> set[bytes]:
    lines = set()
    for file in _files(cache):
        with suppress(OSError):
            lines.add(hash_line(file, f"{file.parent.name}/{file.name}"))
    return lines


def _keep_changes(cache: Path, before: set[tuple[Path, int, int]]) -> None:
    """Keep the hashes at the end of a process that compiled something; a signal leaves them as they were.

    What an exit hook raises would be printed as a traceback.
    """
    with suppress(SystemExit, KeyboardInterrupt):
        if _states(cache) != before:
            _keep(cache)


def _keep(cache: Path) -> None:
    with suppress(OSError, SehdrError), atomic_path(cache / LIST, internal=True) as beside:
        beside.write_bytes(b"".join(line + b"\n" for line in sorted(_lines(cache))))
