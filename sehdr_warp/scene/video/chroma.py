"""Chroma at half of luma's size (4:2:0, 4:2:2) at its full size, with luma as a guide."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from PIL import Image

from ..images.guided_upsampling import enlarge_guided

_TRUSTED = 2.0  # Median deviations from which a difference to the stored chroma is more than noise
_REACH = 3  # Samples beside each one that cubic interpolation reads, of a place up to a quarter aside


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
    height, width = luma.shape
    padding = [(0, 0 if offset is None else size % 2) for size, offset in zip(luma.shape, offsets, strict=True)]
    luma = np.pad(luma, padding, mode="edge")
    change_size = {"reduce": partial(_reduce, offsets=offsets), "enlarge": partial(_enlarge, offsets=offsets)}
    planes = [enlarge_guided(plane, luma, **change_size, trusted=_TRUSTED) for plane in np.moveaxis(chroma, 2, 0)]
    return np.stack([plane[:height, :width] for plane in planes], axis=2)


def _reduce(values: np.ndarray, offsets: Sequence[float | None]) -> np.ndarray:
    """Return averages of [H, W] where the chroma samples lie: of two samples between, of three around one."""
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
    """Return [h, w] at the size of luma, by Catmull-Rom splines (Keys 1981)."""
    height, width = (size * (1 if offset is None else 2) for size, offset in zip(values.shape, offsets, strict=True))
    top, left = (_REACH + (0.0 if offset is None else 0.25 - offset / 2) for offset in offsets)
    padded = Image.fromarray(np.pad(values, _REACH, mode="edge"))
    box = (left, top, left + values.shape[1], top + values.shape[0])
    return np.asarray(padded.resize((width, height), Image.Resampling.BICUBIC, box=box))
