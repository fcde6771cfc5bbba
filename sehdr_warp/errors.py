"""The errors a user can act on, and suggestions for mistyped words."""

import difflib
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from itertools import islice
from numbers import Integral, Real
from pathlib import Path
from typing import Any

MAX_MESSAGE_PART = 400  # Characters of a path and of a problem that a message shows; both may come from a damaged file

MOST_LISTED = 2000  # Entries of a folder among which the one that was meant is looked for

NOT_FINITE_REMEDY = "it is not written; train again from an earlier checkpoint or with another seed"

_ARGUMENTS = {
    **{f"--{name}": f"{name}=True" for name in ("resume", "overwrite", "inpaint")},
    **{f"--{name}": name for name in ("holdout", "evs", "axes", "up", "scale", "crop", "at", "beyond", "ocio", "view")},
    "--camera": "camera",
    "--cameras": "cameras",
    "--max-size": "max_size",
    "--device cpu": 'device="cpu"',
    "--schedule.use-cuda-graph=false": "schedule.use_cuda_graph = False",
}
"""Python names of the flags in messages."""
_shows_flags = False


@contextmanager
def flags_in_messages() -> Iterator[None]:
    """Let messages of errors name flags within the block, which the command line runs in; else they name arguments."""
    global _shows_flags
    before, _shows_flags = _shows_flags, True
    try:
        yield
    finally:
        _shows_flags = before


class SehdrError(Exception):
    """One line that says what is wrong (file, field, value) and what to do about it.

    The command line prints the message and exits with status 1; every other exception is a defect of the program.
    """

    def __str__(self) -> str:
        """Return the message, for a user of the command line or of Python."""
        message = super().__str__()
        if _shows_flags or isinstance(self, UsageError):
            return message
        parts = message.split("`")  # Between them are commands to type.
        for place in range(0, len(parts), 2):
            for flag, argument in _ARGUMENTS.items():
                parts[place] = re.sub(rf"{flag}(?![\w-])", argument, parts[place])
        return "`".join(parts)


class UsageError(SehdrError):
    """A command line that cannot be read: a wrong command, flag or value. The exit status is 2."""


class InputError(SehdrError):
    """A file or a value that cannot be used.

    The message reads `<path>: <problem>; <remedy>`, on one line.

    Attributes:
        path: the file, folder, flag or value.
        problem: what is wrong with it, on one line.
    """

    def __init__(self, path: Path | str, problem: str, remedy: str):
        """Compose the message; remedy says what to do."""
        problem = " ".join(problem.split())  # Libraries' messages may have several lines.
        self.path, self.problem = str(path), problem
        place, what = (
            part[:MAX_MESSAGE_PART] + " ..." * (len(part) > MAX_MESSAGE_PART) for part in (self.path, problem)
        )
        super().__init__(" ".join(f"{place}: {what}; {remedy}".split()))


def require_extra(module: str, purpose: str, extra: str) -> Any:
    """Return an optional module, such as "av"; raise SehdrError, with the extra to install, if it is missing.

    `purpose` is the subject of the message, with a verb, such as "films need PyAV".
    """
    try:
        return import_module(module)
    except ImportError:
        raise SehdrError(f"{purpose}; run `pip install 'sehdr-warp[{extra}]'`") from None


_LOADED = {"load_scene": "train_views", "load_run": "render"}
"""An attribute of what each function returns, by which other values are told from it."""


def require_trained(*values: object) -> None:
    """Raise TypeError for what is not a run of load_run(), such as a file of Gaussians or merged scenes."""
    require_loaded("load_run", *values)
    for value in values:
        if not hasattr(value, "train_seconds"):
            raise TypeError(f"{type(value).__name__} has no training, expected what sehdr_warp.load_run() returns")


def require_loaded(loader: str, *values: object) -> None:
    """Raise TypeError for a path, a list or another value in place of what `loader`() reads from a path.

    Files of Gaussians and merged scenes are taken for runs; see require_trained().
    """
    for value in values:
        if isinstance(value, list | tuple):
            raise TypeError(
                f"a {type(value).__name__} is not what sehdr_warp.{loader}() returns; pass its items one by one"
            )
        if isinstance(value, str | os.PathLike):
            raise TypeError(f"{os.fspath(value)!r} is a path, expected what sehdr_warp.{loader}() returns for it")
        if not hasattr(value, _LOADED[loader]):
            raise TypeError(f"a {type(value).__name__} is not what sehdr_warp.{loader}() returns; pass that")


def path_of(value: object, name: str) -> Path:
    """Return an argument as a path; raise TypeError, naming it, for what is none."""
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name} is {value!r:.60}, expected a path, as text or pathlib.Path")
    return Path(os.fsdecode(value))


def require_number(value: object, name: str) -> None:
    """Raise TypeError for an argument that is not a number."""
    if not isinstance(value, Real):
        raise TypeError(f"{name} is {value!r:.60}, expected a number")


def require_whole_number(value: object, name: str, least: int | None = None) -> None:
    """Raise TypeError for an argument that is not a whole number, and SehdrError for one below `least`, unless None."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} is {value!r:.60}, expected a whole number")
    if least is not None and value < least:
        raise SehdrError(f"{name} {value} is below {least}; give {least} or more")


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that a mistyped one most likely stands for, or None if none is similar."""
    matches = difflib.get_close_matches(word.lower(), sorted(known), 1)
    return matches[0] if matches else None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return `, did you mean X?` for the most similar known word, or "" if none is similar."""
    suggestion = nearest(word, known)
    return f", did you mean {suggestion}?" if suggestion else ""


def missing(path: Path | str, problem: str, remedy: str) -> InputError:
    """Return the error of a path that does not exist; the remedy names a similar path beside it, if there is one.

    Args:
        path: What is not there.
        problem: What is wrong, such as "not found".
        remedy: What to do if nothing beside it has a similar name.
    """
    path, names = Path(path), list[str]()
    with suppress(OSError):
        if path.is_symlink():
            return InputError(path, f"is a link to {path.readlink()}, which is not there", "correct the link")
        names = [entry.name for entry in islice(path.parent.iterdir(), MOST_LISTED)]
    similar = nearest(path.name, names)
    return InputError(path, problem, f"did you mean {path.with_name(similar)}?" if similar else remedy)


# Control characters but line ends and tabs, and those that change the direction of text.
_HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def visible(text: str) -> str:
    """Return text of which a terminal obeys nothing: names of files and what files say may hold its commands."""
    return _HIDDEN.sub(lambda match: ascii(match[0])[1:-1], text)


_OUT_OF_MEMORY = re.compile(
    r"allocate memory|[Ff]ailed to allocate|bad_alloc|out of memory|map segment|start new thread|without exception set"
)


def as_user_error(error: Exception) -> SehdrError | None:
    """Return an exception as an error of one line if its cause is outside the program, else None.

    Such causes are a path that the system refuses, a file name that is not text, and exhausted memory.
    """
    if isinstance(error, SehdrError):
        return error
    cause = error.__cause__ or error.__context__
    kinds = RuntimeError | ImportError | OSError | SystemError
    out_of_memory = isinstance(error, kinds) and _OUT_OF_MEMORY.search(f"{error} {cause or ''}")
    if out_of_memory or isinstance(error, MemoryError) or isinstance(cause, MemoryError):
        reason = (str(error).splitlines() or ["no more"])[0]
        remedy = "use smaller photos (--max-size), smaller pictures (--size) or a larger machine"
        return SehdrError(f"out of memory ({reason}); {remedy}")
    if isinstance(error, OSError) and error.strerror:
        path = error.filename if isinstance(error.filename, str | bytes) else "a file"
        return InputError(os.fsdecode(path), f"cannot be used ({error.strerror})", "check the path and its permissions")
    if isinstance(error, UnicodeEncodeError):
        return InputError(ascii(error.object), "is a name that is not UTF-8 text", "rename it")
    return None
