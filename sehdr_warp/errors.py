"""The errors a user can act on, and the nearest right word for a wrong one."""

import difflib
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
