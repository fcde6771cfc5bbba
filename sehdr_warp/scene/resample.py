"""Exact area averaging."""

import numpy as np


def limited_size(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """The size with the longest side at most max_size pixels and the same aspect, rounded; never larger."""
    scale = 1.0 if max_size is None else min(1.0, max_size / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def area_average(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """[H, W] or [H, W, C] float -> [height, width(, C)] float32: each pixel the mean of the area that it covers.

    Exact for any ratio (pixels on a border count in part); width and height are not above the image's.
    """
    for axis, size in enumerate((height, width)):
        if image.shape[axis] != size:
            lines = np.moveaxis(image, axis, 0)
            mean = _overlaps(len(lines), size) @ lines.reshape(len(lines), -1)
            image = np.moveaxis(mean.reshape(size, *lines.shape[1:]), 0, axis)
    return np.ascontiguousarray(image, dtype=np.float32)


def _overlaps(source: int, target: int):
    """[target, source] sparse float32: the share of each source pixel in each target pixel; rows sum to 1."""
    from scipy.sparse import csr_array

    edges = np.arange(target + 1) * (source / target)
    first = np.floor(edges[:-1] + 1e-9).astype(int)
    last = np.minimum(np.ceil(edges[1:] - 1e-9).astype(int), source)
    counts = last - first
    row = np.repeat(np.arange(target), counts)
    column = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
    weight = np.minimum(column + 1, edges[row + 1]) - np.maximum(column, edges[row])
    return csr_array(((weight / (source / target)).astype(np.float32), (row, column)), shape=(target, source))
