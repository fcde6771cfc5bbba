"""Downsampling of pictures by exact area averages."""

from collections.abc import Callable

import numpy as np

_BAND_VALUES = 1 << 20  # Values that are averaged at one time: 4 MB, which caches hold


def area_average(
    image: np.ndarray, width: int, height: int, values: Callable[[slice], np.ndarray | None] | None = None
) -> np.ndarray:
    """Downsample [H, W] or [H, W, C] to float32 [height, width(, C)], each pixel the exact mean of the area it covers.

    Args:
        image: the pixels.
        width: not larger than the image's.
        height: not larger than the image's.
        values: returns the float32 values of a slice of rows, by default the pixels; it is called for few rows at a
            time, because a photo may be too large to be converted to floats as a whole. None stands for rows of 0.
    """
    values = values or (lambda rows: image[rows].astype(np.float32, copy=False))
    count = image.shape[0]
    if height != count:
        shares, means = _overlaps(count, height), []
        step = max(1, height * _BAND_VALUES // image.size)
        for start in range(0, height, step):
            part = shares[start : start + step]
            first, last = int(part.indices.min()), int(part.indices.max()) + 1
            if (lines := values(slice(first, last))) is None:
                means.append(np.zeros((min(step, height - start), *image.shape[1:]), np.float32))
            else:
                means.append((part[:, first:last] @ lines.reshape(len(lines), -1)).reshape(-1, *lines.shape[1:]))
        image = np.concatenate(means)
    else:
        lines = values(slice(0, count))
        image = np.zeros(image.shape, np.float32) if lines is None else lines
    if image.shape[1] != width:
        lines = np.moveaxis(image, 1, 0)
        mean = _overlaps(len(lines), width) @ lines.reshape(len(lines), -1)
        image = np.moveaxis(mean.reshape(width, *lines.shape[1:]), 0, 1)
    return np.ascontiguousarray(image, dtype=np.float32)


def _overlaps(source: int, target: int):
    """Return the share of each source pixel in each target pixel, sparse float32 [target, source]; rows sum to 1."""
    from scipy.sparse import csr_array

    edges = np.arange(target + 1) * (source / target)
    first = np.floor(edges[:-1] + 1e-9).astype(int)
    last = np.minimum(np.ceil(edges[1:] - 1e-9).astype(int), source)
    counts = last - first
    row = np.repeat(np.arange(target), counts)
    column = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
    weight = np.minimum(column + 1, edges[row + 1]) - np.maximum(column, edges[row])
    return csr_array(((weight / (source / target)).astype(np.float32), (row, column)), shape=(target, source))
