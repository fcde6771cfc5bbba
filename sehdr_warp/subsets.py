"""Subsets of photos and points, small enough to look at."""

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

Item = TypeVar("Item")


def every_nth(items: Any, most: int) -> Any:
    """Return every n-th of a sequence or array, with the smallest n that leaves at most `most`, from 1."""
    return items[:: -(-len(items) // most) or 1]


def evenly(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most `count` items, evenly chosen from the first to the last."""
    import numpy as np

    return [items[i] for i in sorted({round(i) for i in np.linspace(0, len(items) - 1, count)})]


def first_names(names: Sequence[str], most: int = 3) -> str:
    """Return "a, b, c" or, of more than `most` names, "a, b, c ..."."""
    return ", ".join(names[:most]) + " ..." * (len(names) > most)


def all_names(names: Sequence[str], indices: Iterable[int]) -> str:
    """Return all names at ascending indices: "a, c to f", with rows of three or more neighbors in short."""
    rows: list[list[int]] = []
    for index in indices:
        if rows and rows[-1][-1] == index - 1:
            rows[-1].append(index)
        else:
            rows.append([index])
    texts = (
        f"{names[row[0]]} to {names[row[-1]]}" if len(row) > 2 else ", ".join(names[i] for i in row) for row in rows
    )
    return ", ".join(texts)


def counted(count: int, one: str, several: str) -> str:
    """Return "1 photo is" or "3 photos are" of "photo is" and "photos are"."""
    return f"{count} {one if count == 1 else several}"
