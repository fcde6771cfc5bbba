"""Subsets of photos and points, small enough to look at."""

from collections.abc import Sequence
from typing import Any


def every_nth(items: Any, most: int) -> Any:
    """Return every n-th of a sequence or array, with the smallest n that leaves at most `most`, from 1."""
    return items[:: -(-len(items) // most) or 1]


def first_names(names: Sequence[str], most: int = 3) -> str:
    """Return "a, b, c" or, of more than `most` names, "a, b, c ..."."""
    return ", ".join(names[:most]) + " ..." * (len(names) > most)
