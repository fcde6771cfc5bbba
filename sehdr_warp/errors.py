"""The errors a user can act on, and the nearest right word for a wrong one."""

import difflib
import os
import re
from collections.abc import Iterable
from pathlib import Path


class SehdrError(Exception):
    """One line that says what is wrong (file, field, value) and what to do about it.

    The command line prints the message and exits with status 1; every other exception is a defect of the program.
    """


class UsageError(SehdrError):
    """A command line that cannot be read: a wrong command, flag or value. Exits with status 2."""


LONGEST_PART = 400
"""Characters of a path and of a problem that a message tells."""


class InputError(SehdrError):
    """A file or a value that was handed in cannot be used.

    The message reads `<path>: <problem>; <remedy>`, on one line.
    """

    def __init__(self, path: Path | str, problem: str, remedy: str):
        self.path, self.problem = str(path), problem
        # A problem may quote a file, which may hold anything; names of files may come from files as well.
        place, problem = (
            text if len(text) <= LONGEST_PART else text[:LONGEST_PART] + " ..." for text in (str(path), problem)
        )
        super().__init__(" ".join(f"{place}: {problem}; {remedy}".split()))


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known word that a mistyped one most likely stands for; None if none is near."""
    found = difflib.get_close_matches(word.lower(), sorted(known), 1)
    return found[0] if found else None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`, did you mean X?` for the nearest known word, or nothing: to be put behind a message."""
    near = nearest(word, known)
    return f", did you mean {near}?" if near else ""


_NO_MEMORY = re.compile(r"allocate memory|[Ff]ailed to allocate|bad_alloc|out of memory|map segment|start new thread")


def surroundings_told(error: Exception) -> SehdrError | None:
    """What went wrong around the program, as an error of one line: a path that the system refuses, a name that is no
    text, no memory. None for what is a defect."""
    if isinstance(error, SehdrError):
        return error
    said = f"{error} {error.__cause__ or error.__context__ or ''}"
    short = isinstance(error, RuntimeError | ImportError | OSError) and _NO_MEMORY.search(said)
    if short or isinstance(error, MemoryError):
        told = (str(error).splitlines() or ["no more"])[0]
        return SehdrError(f"out of memory ({told}); use smaller photos (--max-size) or a larger machine")
    if isinstance(error, OSError) and error.strerror:
        place = error.filename if isinstance(error.filename, str | bytes) else "a file"
        return InputError(os.fsdecode(place), f"cannot be used ({error.strerror})", "check the path and its rights")
    if isinstance(error, UnicodeEncodeError):
        return InputError(ascii(error.object), "is a name that is not UTF-8 text", "rename it")
    return None
