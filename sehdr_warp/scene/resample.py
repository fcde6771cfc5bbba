"""Exact area averaging."""

import numpy as np


def limited_size(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """The size with the longest side at most max_size pixels and the same aspect, rounded; never larger."""
    if max_size is None or max(width, height) <= max_size:
        return width, height
    scale = max_size / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def area_average(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """[H, W] or [H, W, C] float -> [height, width(, C)] float32: each pixel the mean of the area that it covers.

    Exact for any ratio (pixels on a border count in part); width and height are not above the image's.
    """
    if image.shape[:2] == (height, width):
        return image.astype(np.float32, copy=False)
    rows = _overlaps(image.shape[0], height)
    columns = _overlaps(image.shape[1], width)
    narrow = rows @ image.reshape(image.shape[0], -1)
    narrow = narrow.reshape(height, image.shape[1], -1).transpose(1, 0, 2)
    small = (columns @ narrow.reshape(image.shape[1], -1)).reshape(width, height, -1).transpose(1, 0, 2)
    return np.ascontiguousarray(small.reshape(height, width, *image.shape[2:]), dtype=np.float32)


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


def restore_clipping(image: np.ndarray, clipped_share: np.ndarray) -> np.ndarray:
    """Set values to 1 where at least half of the averaged area was clipped, per channel.

    A mean over clipped samples is only a lower bound. With half of the area clipped the bound says little, and 1
    ("at least this bright") is the honest value; with less, the mean stays, a slight underestimate that a single
    clipped sample must not turn into white.
    """
    return np.where(clipped_share >= 0.5, np.float32(1.0), image)
