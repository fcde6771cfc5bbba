"""Light as 16-bit sRGB codes, a few rows of a photo at a time."""

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np

from .float_table import FloatTable
from .primaries import linear_to_srgb

_BAND_PIXELS = 1 << 16  # Pixels that are converted at a time, whose floats stay in the caches of a processor


def bands_of(rows: slice, width: int) -> Iterator[slice]:
    """Yield bands of rows whose colors are converted at a time.

    Args:
        rows: of a photo, with start and stop.
        width: of the photo in pixels.
    """
    step = max(1, _BAND_PIXELS // width)
    for top in range(rows.start, rows.stop, step):
        yield slice(top, min(top + step, rows.stop))


def encoded_in_bands(
    pixels: np.ndarray,
    above: np.ndarray | None,
    to_linear: Callable[[np.ndarray, np.ndarray | None], tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray | None]:
    """Encode linear Rec.709 as 16-bit sRGB codes.

    Args:
        pixels: [H, W, 3] codes; a few rows are converted at a time, because floats take much memory.
        above: [H, W, 3] light above white that is known beside them, or None.
        to_linear: returns linear Rec.709 and clipped channels of rows.

    Returns:
        Codes, white where a channel is clipped, and [H, W, 3] float16 light of unclipped pixels above white, 0
        elsewhere; None if there is none.
    """
    codes, brighter = np.empty(pixels.shape, np.uint16), None
    for rows in bands_of(slice(0, len(pixels)), pixels.shape[1]):
        light, clipped = to_linear(pixels[rows], None if above is None else above[rows])
        encoded = _srgb_codes()(light)
        encoded[clipped] = 65535
        codes[rows] = encoded
        measurable = (light > 1) & ~clipped
        if measurable.any():
            brighter = np.zeros(pixels.shape, np.float16) if brighter is None else brighter
            brighter[rows] = np.where(measurable, light, 0)
    return codes, brighter


@cache
def _srgb_codes() -> FloatTable:
    """Return the encoding of light as 16-bit sRGB codes, exact to one code."""
    return FloatTable(lambda light: 65535 * np.clip(linear_to_srgb(light), 0, 1), np.uint16)
