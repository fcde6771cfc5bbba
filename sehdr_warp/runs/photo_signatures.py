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
    """Return whether signatures have other parts, or cells that differ by more than _TOLERANCE."""
    try:
        one, other = ([np.frombuffer(bytes.fromhex(part), np.uint8) for part in s.split("/")] for s in (first, second))
    except ValueError:
        return True
    if [cells.shape for cells in one] != [cells.shape for cells in other]:
        return True
    return any((np.abs(a.astype(int) - b) > _TOLERANCE).any() for a, b in zip(one, other, strict=True))
