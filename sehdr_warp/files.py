"""Files: written whole or not at all, and read within bounds, under names that stay in their folder.

What is written lies beside its place, is flushed to the disk, then renamed; what a killed process left is removed when
something is written to the same folder again.
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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from sehdr_warp.errors import InputError, SehdrError

_REFUSALS = "ENOSPC EDQUOT EFBIG EROFS EACCES EPERM EIO ENAMETOOLONG ENOTDIR EISDIR EMFILE"
_WRITE_ERRORS = {getattr(errno, name) for name in _REFUSALS.split() if hasattr(errno, name)}

# The largest file that is read whole: the biggest COLMAP models in use (Mip-NeRF 360, city captures) are well under it.
MAX_FILE_BYTES = 4 << 30
MAX_JSON_BYTES = 256 << 20


@contextmanager
def atomic_path(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """Yields a temporary path in the folder of `path`; what is written there becomes `path` when the block ends.

    The temporary name keeps the suffix, for writers that choose a format by it. Missing parent folders are made.
    If the block raises, the temporary file and the folders made are removed, and an existing `path` stays as it was.

    Raises InputError where `path` exists (unless overwrite, and never for a folder), SehdrError where the disk is
    full or the folder is not writable.
    """
    with _written_beside(Path(path), overwrite, folder=False) as temporary:
        yield temporary


@contextmanager
def atomic_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """As atomic_path, of a folder. An empty one at `path` counts as absent; with overwrite an existing one is set
    aside, and removed only once the new one stands in its place."""
    with _written_beside(Path(path), overwrite, folder=True) as temporary:
        temporary.mkdir()
        yield temporary


@contextmanager
def _written_beside(path: Path, overwrite: bool, folder: bool) -> Iterator[Path]:
    _remove_stale(path)
    check_absent(path, overwrite, folder=folder)
    with writing(path):
        made, temporary = _make_parents(path), _beside(path)
        try:
            yield temporary
            for written in (temporary, *temporary.rglob("*")):
                _sync(written)
            check_absent(path, overwrite, folder=folder)
            _put(temporary, path)
        except BaseException as error:
            if isinstance(error, SehdrError):
                # Whoever writes names files by the temporary name, which means nothing to the user.
                error.args = tuple(str(item).replace(str(temporary), str(path)) for item in error.args)
            _remove(temporary)
            with suppress(OSError):  # Someone else has put a file there in the meantime.
                for parent in made:
                    parent.rmdir()
            raise


def write_json(path: Path | str, value: Any, overwrite: bool = False) -> None:
    """Writes plain values as indented UTF-8 JSON, atomically; NaN and infinity become null, as JSON has neither.

    Raises InputError and SehdrError as atomic_path does, TypeError for a value that is not plain.
    """
    text = json.dumps(_finite(value), indent=2, ensure_ascii=False) + "\n"
    with atomic_path(path, overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """The whole file; raises InputError where it is missing, unreadable, empty or larger than `limit` bytes."""
    try:
        size = path.stat().st_size
        if size > limit:
            problem = f"{size} bytes is more than the limit of {limit}"
            raise InputError(path, problem, "check that this is the right file")
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "file not found", "check the data folder") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error})", "check the file and its rights") from None
    if not data:
        raise InputError(path, "file is empty", "copy or export the file again")
    return data


def read_text(path: Path, limit: int = MAX_FILE_BYTES) -> str:
    """The whole file as UTF-8 text; raises InputError as read_bytes does, and where it is not text."""
    try:
        return read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 text (byte {error.start})", "export the file again") from None


def read_json(path: Path) -> dict:
    """The JSON object in a file; raises InputError where it is missing, broken or not an object."""
    text = read_text(path, MAX_JSON_BYTES)
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not valid JSON ({error})", "export the file again") from None
    if not isinstance(values, dict):
        raise InputError(path, f"holds a JSON {type(values).__name__}, not an object", "export the file again")
    return values


def contained(folder: Path, name: str, source: Path) -> Path:
    """The file that `name` (read from `source`) means inside `folder`.

    Links inside the folder that lead out of it are refused like `..`: a downloaded data set must not be able to read
    any other file of the user's. Raises InputError for an absolute name, a name with `..`, or one that leaves `folder`.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(source, f"file name {name!r} is not usable", "correct the entry")
    try:
        if PurePosixPath(name).is_absolute() or PureWindowsPath(name).anchor:
            problem = "is absolute"
        elif ".." in PureWindowsPath(name).parts:
            problem = "contains '..'"
        elif not (folder / name).resolve().is_relative_to(folder.resolve()):
            problem = "leads outside the data folder"
        else:
            return folder / name
    except (OSError, ValueError, RuntimeError) as error:
        problem = f"cannot be resolved ({error})"
    short = repr(name if len(name) <= 80 else name[:77] + "...")
    raise InputError(source, f"file name {short} {problem}", f"use a path relative to {folder} without '..'")


def check_absent(path: Path | str, overwrite: bool = False, *, folder: bool = False) -> None:
    """Raises InputError where a file (or a folder that is not empty) at `path` would have to be replaced without leave,
    or the other of both is in the way."""
    path = Path(path)
    if not (path.exists() or path.is_symlink()):
        return
    if path.is_dir() != folder:
        here, wanted = ("a file", "a folder") if folder else ("a folder", "a file")
        raise InputError(path, f"is {here}, not {wanted}", "choose another name")
    if not overwrite and not (folder and not any(path.iterdir())):
        raise InputError(path, "exists already", "choose another place, or ask for it to be replaced (--overwrite)")


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Turns the operating system's refusals to write `path` (a full disk, no rights) into a SehdrError of one line."""
    try:
        yield
    except OSError as error:
        if error.errno not in _WRITE_ERRORS and not isinstance(error, FileExistsError):
            raise
        reason = os.strerror(error.errno or 0)
        raise SehdrError(f"{path}: cannot be written ({reason}); free space or choose another folder") from error


def _beside(path: Path, kind: str = "tmp") -> Path:
    """A new hidden name beside `path` that says whose it is, and whether it is written (`tmp`) or set aside (`old`)."""
    # Short stems keep the temporary name within the 255 bytes that file systems allow.
    owner = f"{_process_space()}-{os.getpid()}-{secrets.token_hex(4)}"
    return path.with_name(f".{path.stem[:40]}.{owner}.{kind}{path.suffix[:20]}")


@functools.cache
def _process_space() -> str:
    """Eight digits that tell the process numbers of this machine or container from another's on the same disk."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return hashlib.blake2s(f"{platform.node()} {space}".encode(), digest_size=4).hexdigest()


def _remove_stale(path: Path) -> None:
    """Removes what killed processes of this machine left in the folder of `path`. A folder that was set aside to be
    replaced by `path` goes back where nothing stands in its place; what others may still be writing is left alone."""
    names = re.compile(rf"\.(.*)\.{_process_space()}-(\d+)-[0-9a-f]{{8}}\.(tmp|old)(\.[^.]*)?", re.ASCII)
    try:
        found = [match for name in os.listdir(path.parent) if (match := names.fullmatch(name))]
    except OSError:  # No such folder yet, or not ours to read.
        return
    for match in (match for match in found if not _runs(int(match[2]))):
        left, ours = path.parent / match[0], match[1] + (match[4] or "") == path.name
        if match[3] == "tmp" or (ours and path.exists()):
            _remove(left)
        elif ours:
            with suppress(OSError):  # Another process was as quick.
                os.rename(left, path)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _runs(process: int) -> bool:
    """Whether a process of this number runs here; yes where that cannot be told."""
    with suppress(PermissionError, OverflowError):  # Someone else's process, or no number of one.
        try:
            if os.name == "posix":  # Elsewhere os.kill ends the process.
                os.kill(process, 0)
        except ProcessLookupError:
            return False
    return True


def _make_parents(path: Path) -> list[Path]:
    """Makes the missing folders above a path, and says which, the deepest first."""
    missing = list(takewhile(lambda parent: not parent.exists(), path.absolute().parents))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(path.parent, "is a file, or in one, and not a folder", "choose another place") from None
    except FileNotFoundError:  # A file system that makes none, such as /proc, or a folder just deleted.
        raise SehdrError(f"{path.parent}: this folder cannot be made; choose another place") from None
    return missing


def _put(temporary: Path, path: Path) -> None:
    """Gives what is written its name; a folder that stands there is set aside until then, and only then removed."""
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
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
