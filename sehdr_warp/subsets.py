"""Subsets of photos and points, small enough to look at."""

from collections.abc import Sequence
from typing import Any


def every_nth(items: Any, most: int) -> Any:
    """Return every n-th of a sequence or array, with the smallest n that leaves at most `most`, from 1."""
    return items[:: -(-len(items) // most) or 1]


def first_names(names: Sequence[str], most: int = 3) -> str:
    """Return "a, b, c" or, of more than `most` names, "a, b, c ..."."""
    return ", ".join(names[:most]) + " ..." * (len(names) > most)


def counted(count: int, one: str, several: str) -> str:
    """Return "1 photo is" or "3 photos are" of "photo is" and "photos are"."""
    return f"{count} {one if count == 1 else several}"
