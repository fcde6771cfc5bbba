"""Signatures of photos: whether a training is resumed with the photos that it began with.

A signature is the mean of the codes in a grid of GRID x GRID cells, of 8 bits each. It survives another decoder, whose
codes may differ by one, and changes with a photo that was edited, exchanged or developed anew. That of a masked photo
has a second part, of the mask.
"""

from collections.abc import Mapping

import numpy as np

GRID = 8
_MOST_ROWS = 32
"""Rows that are read of each row of cells; more would take longer for large photos and find little more."""
_TOLERANCE = 2
"""Codes of 255 that a cell may differ by: decoders differ by one, and the mean is rounded."""


def photo_signature(codes: np.ndarray, mask: np.ndarray | None = None) -> str:
    """Return hexadecimal digits of codes [H, W, 3], uint8 or uint16, and of a mask [H, W] in [0, 1]."""
    if mask is None:
        return _means(codes)
    return f"{_means(codes)}/{_means(np.rint(mask * np.float32(255)).astype(np.uint8)[..., None])}"


def _means(codes: np.ndarray) -> str:
    height, width = codes.shape[:2]
    means = np.zeros((GRID, GRID))
    columns = [slice(*edge) for edge in _edges(width)]
    for row, (top, bottom) in enumerate(_edges(height)):
        band = np.asarray(codes[top : bottom : max(1, (bottom - top) // _MOST_ROWS)])
        means[row] = [band[:, part].mean() for part in columns]
    return np.rint(means * (255 / np.iinfo(codes.dtype).max)).astype(np.uint8).tobytes().hex()


def changed_photos(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the names of photos whose signatures differ; a name without a signature on either side does not count."""
    return [name for name in before if name in now and _differ(before[name], now[name])]


def _edges(length: int) -> list[tuple[int, int]]:
    """Return first and last pixel of each of GRID cells, which overlap if there are fewer pixels than cells."""
    starts = [index * length // GRID for index in range(GRID)]
    return [(start, max(start + 1, (index + 1) * length // GRID)) for index, start in enumerate(starts)]


def _differ(first: str, second: str) -> bool:
    parts = first.split("/"), second.split("/")
    if len(parts[0]) != len(parts[1]):
        return True
    return any(map(_cells_differ, *parts))


def _cells_differ(first: str, second: str) -> bool:
    try:
        cells = [np.frombuffer(bytes.fromhex(text), np.uint8).astype(int) for text in (first, second)]
    except ValueError:
        return True
    return cells[0].shape != cells[1].shape or bool((np.abs(cells[0] - cells[1]) > _TOLERANCE).any())
