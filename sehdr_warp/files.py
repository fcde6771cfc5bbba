"""Write files whole or not at all, and read them within bounds, under names that stay in their folder.

A file is written beside its place, flushed to the disk, then renamed. Leftovers of a killed process are removed when
something is written to the same folder again. The list of the folder (see own_files.py) gets its hash, because only a
file that is as listed is ever replaced. What is written within atomic_folder() is listed with the folder, once.
"""

import errno
import functools
import hashlib
import json
import math
import os
import platform
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from .errors import InputError, SehdrError
from .json_values import description_of
from .own_files import first_unlisted, list_file, list_folder

_REFUSALS = "ENOSPC EDQUOT EFBIG EROFS EACCES EPERM EIO ENAMETOOLONG ENOTDIR EISDIR EMFILE"
_WRITE_ERRORS = {getattr(errno, name) for name in _REFUSALS.split() if hasattr(errno, name)}
MAX_FILE_BYTES = 4 << 30  # Of a file that is read whole; the biggest COLMAP models (city captures) are well under it
MAX_JSON_BYTES = 256 << 20
_MAX_LINE = 16 << 20


@contextmanager
def atomic_path(path: Path | str, overwrite: bool = False, *, internal: bool = False) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; what is written there becomes `path` when the block ends.

    The temporary name keeps the suffix, for writers that choose a format by it. Missing parent folders are made.
    If the block raises, the temporary file and the folders made are removed, and an existing `path` stays as it was.

    Args:
        path: The file.
        overwrite: A file that this program wrote may be replaced.
        internal: `path` is a name of the program's own in its own folder: any file there is replaced, none is listed.

    Raises:
        InputError: If `path` exists (unless it may be replaced), or is a folder, a link or a device.
        SehdrError: If the disk is full or the folder is not writable.
    """
    with _written_beside(Path(path), overwrite, internal, folder=False) as temporary:
        yield temporary


@contextmanager
def atomic_folder(path: Path | str, overwrite: bool = False, *, internal: bool = False) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` when the block ends; arguments and errors as in atomic_path.

    An empty folder at `path` counts as absent. With overwrite, one that holds only files of this program is set aside,
    and removed once the new one is in its place.
    """
    with _written_beside(Path(path), overwrite, internal, folder=True) as temporary:
        temporary.mkdir()
        yield temporary


@contextmanager
def _written_beside(path: Path, overwrite: bool, internal: bool, folder: bool) -> Iterator[Path]:
    if not (in_temporary := any(_TEMPORARY_NAME.fullmatch(part.name) for part in (path, *path.absolute().parents))):
        remove_stale(path)  # A new folder has no leftovers, and listing it for each of its files takes time.
    internal = internal or in_temporary
    check_absent(path, overwrite, folder=folder, internal=internal)
    with writing(path):
        new_parents, temporary = make_parents(path), _beside(path)
        try:
            yield temporary
            if folder and not internal:
                list_folder(temporary)
            for file in (temporary, *temporary.rglob("*")):
                _sync(file)
            check_absent(path, overwrite, folder=folder, internal=internal)
            if not (folder or internal):
                list_file(temporary, path)
            _put(temporary, path)
        except BaseException as error:
            if isinstance(error, SehdrError):  # It names the temporary file, which means nothing to the user.
                error.args = tuple(str(item).replace(str(temporary), str(path)) for item in error.args)
            remove(temporary)
            with suppress(OSError):  # Someone else has put a file there in the meantime.
                for parent in new_parents:
                    parent.rmdir()
            raise


def write_json(path: Path | str, value: Any, overwrite: bool = False, *, internal: bool = False) -> None:
    """Write plain values as indented UTF-8 JSON, atomically; NaN and infinity become null, because JSON has neither.

    Raises:
        InputError, SehdrError: As atomic_path does.
        TypeError: For a value that is not plain.
    """
    text = json.dumps(_finite(value), indent=2, ensure_ascii=False) + "\n"
    with atomic_path(path, overwrite, internal=internal) as temporary:
        # Bytes of a file's name that are no UTF-8 become escapes, which JSON has as well.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


class UnreadableError(InputError):
    """A file that the system does not let this user read; its content is not at fault."""

    def __init__(self, path: Path | str, error: OSError):
        """Set the message from the system's error."""
        super().__init__(path, f"cannot be read ({error.strerror})", "check its permissions")


def refuse_links(path: Path, folder: Path) -> None:
    """Raise InputError if a path in a folder, or a folder between the two, is a link."""
    for place in (path, *path.parents):
        if place == folder:
            return
        if place.is_symlink():
            problem = "is a link, and links in it are not followed"
            raise InputError(place, problem, "replace the link by the file or folder that it leads to")


def has_file(path: Path) -> bool:
    """Return whether there is a file; raise InputError if a folder, a pipe, a device or a broken link has its name."""
    if os.path.lexists(path) and not path.is_file():
        raise InputError(path, "is a folder, a pipe, a device or a broken link, not a file", "remove it")
    return path.is_file()


def plain_size(path: Path) -> int:
    """Return the bytes of a file; raise InputError for a folder, a pipe or a device, which may never end."""
    size = path.stat().st_size
    if not path.is_file():
        raise InputError(path, "is a folder, a pipe or a device, not a file", "name a file")
    return size


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """Return the whole file; raise InputError if it is missing, unreadable, empty, a pointer or above `limit` bytes."""
    try:
        if (size := plain_size(path)) > limit:
            problem = f"{size} bytes is more than the limit of {limit}"
            raise InputError(path, problem, "check that this is the right file")
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "file not found", "check the name") from None
    except OSError as error:
        raise UnreadableError(path, error) from None
    if not data:
        raise InputError(path, "file is empty", "copy or export the file again")
    if data.startswith(b"version https://git-lfs"):
        raise InputError(path, "is a Git LFS pointer, not the file itself", "fetch it with `git lfs pull`")
    return data


def read_text(path: Path, limit: int = MAX_FILE_BYTES, errors: str = "strict") -> str:
    """Return the whole file as UTF-8 text; raise InputError as read_bytes does, and if bytes.decode finds errors."""
    try:
        return read_bytes(path, limit).decode("utf-8-sig", errors)
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 text (byte {error.start})", "export the file again") from None


def read_lines(path: Path, errors: str = "strict") -> Iterator[str]:
    """Yield the lines of a file of UTF-8 text; raise InputError as read_text does, and for a line that is too long.

    errors: "strict", or "surrogateescape" to keep bytes that are not UTF-8, as Python keeps them in names of files.
    """
    try:
        if plain_size(path) < 1024:
            read_bytes(path)  # It refuses an empty one, and a pointer.
        with open(path, encoding="utf-8-sig", errors=errors) as file:
            while line := file.readline(_MAX_LINE):
                if len(line) == _MAX_LINE:
                    raise InputError(path, f"has a line of over {_MAX_LINE} characters", "check that this is the file")
                yield line.rstrip("\n")
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 text ({error.reason})", "export the file again") from None
    except OSError as error:
        problem = "file not found" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise InputError(path, problem, "check the data folder") from None


def read_json(path: Path, limit: int = MAX_JSON_BYTES) -> dict:
    """Return the JSON object in a file; raise InputError if it is missing, too large, broken or not an object."""
    text = read_text(path, limit)
    try:
        values = json.loads(text, object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not valid JSON ({error})", "export the file again") from None
    if not isinstance(values, dict):
        raise InputError(path, f"holds {description_of(values)}, not an object", "export the file again")
    return values


def unique_keys(pairs: list[tuple[str, Any]]) -> dict:
    """Return an object of JSON by its pairs; raise ValueError for a key that stands twice."""
    values = dict(pairs)
    if len(values) < len(pairs):
        twice = next(name for name, count in Counter(name for name, _ in pairs).items() if count > 1)
        raise ValueError(f"the key {twice!r:.80} stands twice")
    return values


_LONGEST_NAME, _LONGEST_PATH = 255, 3000
"""Bytes of the name of a file on almost all file systems, and of a path below the data folder."""


def resolve_inside(folder: Path, name: str, source: Path) -> Path:
    """Return the file that `name` (read from `source`) means inside `folder`.

    Links inside the folder that lead out of it are refused like `..`: a downloaded data set must not be able to read
    any other file of the user's. Raises InputError for an absolute name, a name with `..`, or one that leaves `folder`.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(source, f"file name {name!r} is not usable", "correct the entry")
    remedy = f"use a path relative to {folder} without '..'"
    try:
        if PurePosixPath(name).is_absolute() or PureWindowsPath(name).anchor:
            problem = "is absolute"
        elif ".." in PureWindowsPath(name).parts:
            problem = "contains '..'"
        elif max(map(len, (data := os.fsencode(name)).split(b"/"))) > _LONGEST_NAME or len(data) > _LONGEST_PATH:
            problem = f"has more than {_LONGEST_PATH} bytes, or more than {_LONGEST_NAME} in a part"
        elif not (folder / name).resolve().is_relative_to(folder.resolve()):
            problem, remedy = "leads outside the data folder by a link", f"copy what it links to into {folder}"
        else:
            return folder / name
    except (OSError, ValueError, RuntimeError) as error:
        problem = f"cannot be resolved ({error})"
    raise InputError(source, f"file name {name!r:.80} {problem}", remedy)


def check_absent(path: Path | str, overwrite: bool = False, *, folder: bool = False, internal: bool = False) -> None:
    """Check before the work that a file or folder can be written; arguments as in atomic_path.

    Raises:
        InputError: If a file, or a folder that is not empty, would be replaced without permission or is not this
            program's, or if something else is in the way.
        SehdrError: If it cannot be written.
    """
    path = Path(path)
    require_text(path)
    for parent in path.parents:
        if parent.exists() and not parent.is_dir():
            raise InputError(parent, "is a file, not a folder", "choose another place")
    parent = next(parent for parent in path.absolute().parents if parent.exists())
    if not os.access(parent, os.W_OK | os.X_OK):
        raise SehdrError(f"{path}: cannot be written (nothing may be made in {parent}); choose another folder")
    if not (path.exists() or path.is_symlink()):
        return
    if path.is_dir() != folder or path.is_symlink() or not (path.is_dir() or path.is_file()):
        kinds = {"a link": path.is_symlink(), "a folder": path.is_dir(), "a file": path.is_file()}
        here = next((kind for kind, holds in kinds.items() if holds), "a device or a pipe")
        raise InputError(path, f"is {here}, not {'a folder' if folder else 'a file'}", "choose another name")
    if internal or (folder and not any(path.iterdir())):
        return
    if not overwrite:
        raise InputError(path, "exists already", "choose another place, or ask for it to be replaced (--overwrite)")
    if (other := first_unlisted(path)) is not None:
        problem = "was not written by sehdr-warp, or was changed since, and is never replaced"
        raise InputError(other, problem, "move it away, or choose another place")


def require_text(name: Path | str) -> None:
    """Raise InputError if a name is not UTF-8 text, which JSON, OpenEXR and USD cannot hold, or has a zero byte."""
    if "\0" in str(name):
        raise InputError(ascii(str(name)), "is a name with a zero byte", "choose another name")
    try:
        str(name).encode()
    except UnicodeEncodeError:
        raise InputError(ascii(str(name)), "is a name that is not UTF-8 text", "rename it") from None


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Turn the system's refusals to write `path` (a full disk, no rights) into a SehdrError of one line."""
    try:
        yield
    except OSError as error:
        if error.errno not in _WRITE_ERRORS and not isinstance(error, FileExistsError):
            raise
        reason = os.strerror(error.errno or 0)
        raise SehdrError(f"{path}: cannot be written ({reason}); free space or choose another folder") from error


_TEMPORARY_NAME = re.compile(r"\.(.*)\.([0-9a-f]{8})-(\d+)-[0-9a-f]{8}\.(tmp|old)(\.[^.]*)?", re.ASCII | re.DOTALL)


def _beside(path: Path, kind: str = "tmp") -> Path:
    """Return a new hidden name beside `path` with its process, and whether it is written (tmp) or set aside (old)."""
    owner = f"{_process_space()}-{os.getpid()}-{secrets.token_hex(4)}"
    return path.with_name(f".{_stem(path)}.{owner}.{kind}{path.suffix[:20]}")


def _stem(path: Path) -> str:
    """Return the stem of a path, shortened if it is long: a name has at most 255 bytes on most file systems."""
    digest = hashlib.blake2s(os.fsencode(path.name), digest_size=4).hexdigest()
    return path.stem if len(path.stem) <= 40 else f"{path.stem[:31]}~{digest}"


@functools.cache
def _process_space() -> str:
    """Return eight digits that distinguish the process numbers of this machine or container on a shared disk."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return hashlib.blake2s(f"{platform.node()} {space}".encode(), digest_size=4).hexdigest()


def remove_stale(path: Path) -> None:
    """Remove leftovers of this machine's killed processes in the folder of `path`.

    A folder that was set aside to be replaced by `path` goes back if nothing is in its place. Names of processes that
    still run, and of other machines, stay.
    """
    try:
        names = [match for name in os.listdir(path.parent) if (match := _TEMPORARY_NAME.fullmatch(name))]
    except OSError:  # No such folder yet, or not readable.
        return
    for match in (match for match in names if match[2] == _process_space() and not _runs(int(match[3]))):
        leftover, same_target = path.parent / match[0], (match[1], match[5] or "") == (_stem(path), path.suffix[:20])
        if match[4] == "tmp" or (same_target and path.exists()):
            remove(leftover)
        elif same_target:
            with suppress(OSError):  # Another process was as quick.
                os.rename(leftover, path)


def remove(path: Path) -> None:
    """Delete a file or folder; what cannot be deleted stays."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _runs(process: int) -> bool:
    """Return whether a process of this number runs here, and True if that is unknown."""
    with suppress(PermissionError, OverflowError):  # Someone else's process, or no number of one.
        try:
            if os.name == "posix":  # Elsewhere os.kill ends the process.
                os.kill(process, 0)
        except ProcessLookupError:
            return False
    return True


def make_parents(path: Path) -> list[Path]:
    """Make the missing folders above a path; return them, the deepest first."""
    missing = list(takewhile(lambda parent: not parent.exists(), path.absolute().parents))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(path.parent, "is a file, or in one, and not a folder", "choose another place") from None
    except FileNotFoundError:  # A file system that makes none, such as /proc, or a folder just deleted.
        raise SehdrError(f"{path.parent}: this folder cannot be made; choose another place") from None
    return missing


def _put(temporary: Path, path: Path) -> None:
    """Rename what is written to its place; a folder there is set aside first, and removed afterwards."""
    old = _beside(path, "old") if path.is_dir() else None
    if old:
        os.rename(path, old)
    try:
        os.replace(temporary, path)
    except OSError:
        if old:
            os.rename(old, path)
        raise
    _sync(path.parent)
    if old:
        shutil.rmtree(old, ignore_errors=True)


def _sync(path: Path) -> None:
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:  # Windows opens no folders.
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOTSUP):  # Some file systems cannot flush folders.
            raise
    finally:
        os.close(handle)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
