"""Chroma at half of luma's size (4:2:0, 4:2:2) at its full size, with luma as a guide.

Where luma changes, chroma of the same surface usually changes in proportion, so a local linear model of chroma by luma
(He, Sun and Tang, Guided Image Filtering, 2010) is fitted at the size of the chroma and applied at full size. What the
model gets wrong by more than noise is added from the stored chroma, so that averages stay what the file states.
"""

from collections.abc import Sequence

import numpy as np

_RADIUS = 1.0  # Standard deviation of the neighborhood of a fit, in chroma samples
_NOISE = 3e-4  # Variance of luma codes in [0, 1] below which luma says little: flat areas keep smooth chroma
_TRUSTED = 2.0  # Median deviations from which a difference to the stored chroma is more than noise
_REACH = 2  # Samples beside each one that cubic interpolation reads
_BAND_ROWS = 256  # Chroma rows that are converted at a time, because floats take much memory
_MARGIN = _REACH + 1  # Chroma rows beside a band that its values depend on


def upsample_chroma(luma: np.ndarray, chroma: np.ndarray, offsets: Sequence[float | None]) -> np.ndarray:
    """Return chroma at luma's size.

    Args:
        luma: [H, W] float32 codes, 1 at white.
        chroma: [h, w, C] float32 in the same unit; an axis is as long as luma's, or half as long, rounded up.
        offsets: place of the first chroma sample on the vertical and horizontal axis in luma samples, 0 to 1; None for
            an axis that is as long as luma's.

    Returns:
        [H, W, C] float32.
    """
    shape = luma.shape
    padding = [(0, 0 if offset is None else size % 2) for size, offset in zip(shape, offsets, strict=True)]
    luma = np.pad(luma, padding, mode="edge")
    small = _reduce(luma, offsets)
    center, center_small = _blur(chroma), _blur(small)
    variance = np.maximum(_blur(small * small) - center_small**2, 0) + _NOISE
    slope = (_blur(small[..., None] * chroma) - center_small[..., None] * center) / variance[..., None]
    result = np.zeros((*luma.shape, chroma.shape[2]), np.float32)
    _add_enlarged(result, slope, offsets, luma[..., None])
    _add_enlarged(result, chroma - slope * small[..., None], offsets)
    difference = chroma - _reduce(result, offsets)
    deviation = np.median(np.abs(difference), axis=(0, 1)) / np.float32(0.6745) * np.float32(_TRUSTED)
    difference *= np.maximum(0, 1 - (deviation / np.maximum(np.abs(difference), np.float32(1e-9))) ** 2)
    _add_enlarged(result, difference, offsets)
    return result[: shape[0], : shape[1]]


def _add_enlarged(
    result: np.ndarray, values: np.ndarray, offsets: Sequence[float | None], factor: np.ndarray | None = None
) -> None:
    """Add to result [H, W, C], in place, values [h, w, C] at its size, times factor [H, W, 1]."""
    step = 1 if offsets[0] is None else 2
    for top in range(0, len(values), _BAND_ROWS):
        start, end = max(top - _MARGIN, 0), min(top + _BAND_ROWS, len(values))
        band = _enlarge(values[start : end + _MARGIN], offsets)[(top - start) * step : (end - start) * step]
        rows = slice(top * step, end * step)
        result[rows] += band if factor is None else band * factor[rows]


def _blur(values: np.ndarray) -> np.ndarray:
    from scipy.ndimage import gaussian_filter  # Takes a second to load

    return gaussian_filter(values, (_RADIUS, _RADIUS, 0)[: values.ndim], mode="nearest", truncate=3)


def _reduce(values: np.ndarray, offsets: Sequence[float | None]) -> np.ndarray:
    """Return averages of [H, W, ...] where the chroma samples lie: of two samples between, of three around one."""
    for axis, offset in enumerate(offsets):
        if offset is None:
            continue
        lines = np.moveaxis(values, axis, 0)
        even, odd = lines[::2], lines[1::2]
        before = np.concatenate([even[:1], odd[:-1]])
        after = np.concatenate([even[1:], odd[-1:]])
        # In the middle of even and odd samples, or on one of them.
        around = {0.0: (before + 2 * even + odd) / 4, 0.5: (even + odd) / 2, 1.0: (even + 2 * odd + after) / 4}
        values = np.moveaxis(around[round(2 * offset) / 2], 0, axis)
    return values


def _enlarge(values: np.ndarray, offsets: Sequence[float | None]) -> np.ndarray:
    """Return [h, w, C] at the size of luma, by Catmull-Rom splines (Keys 1981)."""
    for axis, offset in enumerate(offsets):
        if offset is None:
            continue
        lines = np.moveaxis(values, axis, 0)
        padded = np.pad(lines, ((_REACH, _REACH), *[(0, 0)] * (lines.ndim - 1)), mode="edge")
        result = np.empty((2 * len(lines), *lines.shape[1:]), np.float32)
        for phase in (0, 1):
            distances = np.arange(-_REACH, _REACH + 1) - (phase - offset) / 2
            weights = _cubic(np.abs(distances)).astype(np.float32)
            taps = ((weight, padded[k : k + len(lines)]) for k, weight in enumerate(weights) if weight)
            result[phase::2] = sum(weight * tap for weight, tap in taps)
        values = np.moveaxis(result, 0, axis)
    return values


def _cubic(distance: np.ndarray) -> np.ndarray:
    near = (1.5 * distance - 2.5) * distance**2 + 1
    far = ((2.5 - 0.5 * distance) * distance - 4) * distance + 2
    return np.where(distance < 1, near, np.where(distance < 2, far, 0))
