"""File names found inside data files, and small files read whole: bounded and contained."""

import json
from pathlib import Path, PurePosixPath, PureWindowsPath

from sehdr_warp.errors import InputError

# The largest text or model file that is read whole. The biggest COLMAP models in use (Mip-NeRF 360, city captures)
# stay well under it; a larger one is far more likely a wrong file than a scene.
MAX_FILE_BYTES = 4 << 30
MAX_JSON_BYTES = 256 << 20


def contained(folder: Path, name: str, source: Path) -> Path:
    """The file that `name` (read from `source`) means inside `folder`.

    Links inside the folder that lead out of it are refused like `..`: a downloaded data set must not be able to read
    any other file of the user's. Raises InputError for an absolute name, a name with `..`, or one that leaves `folder`.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(source, f"file name {name!r} is not usable", "correct the entry")
    remedy = f"use a path relative to {folder} without '..'"
    if PurePosixPath(name).is_absolute() or PureWindowsPath(name).drive or PureWindowsPath(name).root:
        raise InputError(source, f"file name {_short(name)} is absolute", remedy)
    if ".." in PurePosixPath(name.replace("\\", "/")).parts:
        raise InputError(source, f"file name {_short(name)} contains '..'", remedy)
    try:
        path = folder / name
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(source, f"file name {_short(name)} cannot be resolved ({error})", remedy) from None
    if not inside:
        raise InputError(source, f"file name {_short(name)} leads outside the data folder", remedy)
    return path


def _short(name: str) -> str:
    return repr(name if len(name) <= 80 else name[:77] + "...")


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """The whole file; raises InputError where it is missing, unreadable, empty or larger than `limit` bytes."""
    try:
        size = path.stat().st_size
        if size > limit:
            raise InputError(
                path, f"{size} bytes is more than the limit of {limit}", "check that this is the right file"
            )
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
