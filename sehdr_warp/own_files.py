"""The list of files that this program has written to a folder, by which --overwrite knows them from a user's.

Each folder has its list in the file LIST: a line `SHA-256  name` for each file. A file that was changed since is the
user's, because the list no longer has its hash.
"""

import errno
import hashlib
import os
from contextlib import suppress
from pathlib import Path

from .errors import InputError

LIST = ".sehdr-warp"
_LARGEST_LIST = 256 << 20  # Bytes of a list that is read; a list of a million files has a third of it


def list_folder(folder: Path) -> None:
    """List all files of a folder as they are."""
    (folder / LIST).write_bytes(b"".join(line + b"\n" for line in _lines(folder)))


def is_as_listed(folder: Path) -> bool:
    """Return whether a folder holds the files of its list, all of them unchanged."""
    with suppress(OSError):
        return set() != read_list(folder) <= set(_lines(folder))
    return False


def first_unlisted(path: Path) -> Path | None:
    """Return the first file at or in a path that this program did not write, or that was changed since; else None."""
    folder = path if path.is_dir() else path.parent
    own = read_list(folder)
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_symlink() or not (file.is_dir() or file == folder / LIST):
            name = file.relative_to(folder).as_posix()
            if file.is_symlink() or not file.is_file() or hash_line(file, name) not in own:
                return file
    return None


def is_own(path: Path) -> bool:
    """Return whether this program wrote a file, or all files of a folder, and nobody changed them since."""
    listed = not path.is_symlink() and read_list(path if path.is_dir() else path.parent)
    return bool(listed) and first_unlisted(path) is None


def hash_line(file: Path, name: str) -> bytes:
    """Return the line of a list for a file, without the end of the line."""
    with open(file, "rb") as opened:
        digest = hashlib.file_digest(opened, "sha256").hexdigest()
    return os.fsencode(f"{digest}  {name}".replace("\n", "\\n"))


def read_list(folder: Path) -> set[bytes]:
    """Return the lines of a folder's list; none if there is no list, or what has its name is not a plain file."""
    file = folder / LIST
    with suppress(OSError):
        if file.is_file() and not file.is_symlink() and file.stat().st_size <= _LARGEST_LIST:
            return set(file.read_bytes().split(b"\n")) - {b""}
    return set()


def list_file(temporary: Path, path: Path) -> None:
    """Add a file that is about to get its name to the list of its folder, in one write, as others may add theirs.

    Raises InputError if a link, a pipe or a device has the list's name.
    """
    file, line = path.parent / LIST, hash_line(temporary, path.name) + b"\n"
    if os.path.lexists(file) and (file.is_symlink() or not file.is_file()):
        raise InputError(file, "is a link, a folder, a pipe or a device, not the list of this folder", "move it away")
    flags = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK"))  # A pipe put there now must not wait.
    handle = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT | flags, 0o666)
    try:
        if os.write(handle, line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))
    except OSError:
        if os.fstat(handle).st_size == 0:  # The list is new and holds nothing.
            file.unlink(missing_ok=True)
        raise
    finally:
        os.close(handle)


def _lines(folder: Path) -> list[bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != LIST)
    return [hash_line(path, path.relative_to(folder).as_posix()) for path in files]
