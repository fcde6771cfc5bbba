"""What the command lines of all rooms share: numbers, and progress on standard error."""

import math
import sys

from .errors import InputError


def numbers(flag: str, text: str | None, kind: type = float, least: float = -math.inf) -> tuple | None:
    """The numbers of a list such as 0.125,0.5,2, None if none was given; raises InputError, with the flag, for anything
    else and for a number below `least`."""
    if text is None:
        return None
    try:
        found = tuple(kind(item) for item in text.split(","))
        if min(found) < least:
            raise ValueError
    except ValueError:
        wanted = "whole numbers" if kind is int else "numbers"
        wanted += f" from {least:g}" if least > -math.inf else ""
        raise InputError(
            f"{flag} {text}", f"not {wanted} separated by commas", f"write for example {flag}=1,2"
        ) from None
    return found


def positive(flag: str, value):
    """The value, if it is above 0; raises InputError, with the flag, if it is not."""
    if not value > 0:
        raise InputError(f"{flag} {value}", "not positive", "give a number above 0")
    return value


def say(line: str) -> None:
    """A line of progress; results go to standard output, this does not."""
    print(line, file=sys.stderr, flush=True)
