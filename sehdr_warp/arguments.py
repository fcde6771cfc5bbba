"""What the command lines of all rooms share: lists of numbers, and progress on standard error."""

import sys

from .errors import SehdrError


def numbers(flag: str, text: str | None, kind: type = float) -> tuple | None:
    """The numbers of a list such as 0.125,0.5,2, None if none was given; raises SehdrError, with the flag, for anything
    else."""
    if text is None:
        return None
    try:
        return tuple(kind(item) for item in text.split(","))
    except ValueError:
        whole = "whole numbers" if kind is int else "numbers"
        raise SehdrError(f"{flag} {text}: not {whole} separated by commas; write for example {flag}=0,2") from None


def say(line: str) -> None:
    """A line of progress; results go to standard output, this does not."""
    print(line, file=sys.stderr, flush=True)
