"""The errors a user can act on."""

from pathlib import Path


class SehdrError(Exception):
    """One line that says what is wrong (file, field, value) and what to do about it.

    The command line prints the message and exits with status 1; every other exception is a defect of the program.
    """


LONGEST_PART = 400
"""Characters of a path and of a problem that a message tells."""


class InputError(SehdrError):
    """A file or a value that was handed in cannot be used.

    The message reads `<path>: <problem>; <remedy>`, on one line.
    """

    def __init__(self, path: Path | str, problem: str, remedy: str):
        self.path = str(path)
        # A problem may quote a file, which may hold anything; names of files may come from files as well.
        place, problem = (
            text if len(text) <= LONGEST_PART else text[:LONGEST_PART] + " ..." for text in (str(path), problem)
        )
        super().__init__(" ".join(f"{place}: {problem}; {remedy}".split()))
