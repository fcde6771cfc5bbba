"""Light as 16-bit sRGB codes, a few rows of a photo at a time, by tables of float32 functions."""

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np

from .primaries import linear_to_srgb

_DROPPED = 10  # Bits of the fraction that are dropped: 13 stay, which are within 6e-5 of a value
_LEAST, _MOST = 2.0**-24, 2.0**17  # The darkest value that photos of 16 bits hold, and the brightest float16
_BAND_PIXELS = 1 << 16  # Pixels that are converted at a time, whose floats stay in the caches of a processor


class FloatTable:
    """A smooth function of values above 0, exact to 6e-5 of its argument."""

    def __init__(self, function: Callable[[np.ndarray], np.ndarray], dtype: type[np.generic] = np.float32):
        """Evaluate the function.

        Args:
            function: of float64 values from 2^-24 to 2^17; those beyond take the value of the end, and those below 0
                that of 0.
            dtype: of the results, which are rounded if it is an integer's.
        """
        first, one, last = (int(np.float32(value).view(np.int32)) >> _DROPPED for value in (_LEAST, 1, _MOST))
        bits = np.arange(first, last + 1, dtype=np.int32) << _DROPPED
        middles = (bits + (1 << (_DROPPED - 1))).view(np.float32).astype(np.float64)
        middles[0], middles[one - first] = 0, 1  # White stays what it is
        values = np.asarray(function(middles))
        values = np.rint(values) if np.issubdtype(dtype, np.integer) else values
        # For all bits that a float may have, so that no place is limited: of negative ones the first is 1.
        self._values = np.full(1 << (32 - _DROPPED), values[0], dtype)
        self._values[first : last + 1] = values
        self._values[last : 1 << (31 - _DROPPED)] = values[-1]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the function of float32 values of any shape, which must lie in a row in memory."""
        return self._values[values.view(np.uint32) >> _DROPPED]


def bands_of(rows: slice, width: int) -> Iterator[slice]:
    """Yield bands of rows whose colors are converted at a time.

    Args:
        rows: of a photo, with start and stop.
        width: of the photo in pixels.
    """
    step = max(1, _BAND_PIXELS // width)
    for top in range(rows.start, rows.stop, step):
        yield slice(top, min(top + step, rows.stop))


@cache
def srgb_codes() -> FloatTable:
    """Return the encoding of light as 16-bit sRGB codes, exact to one code."""
    return FloatTable(lambda light: 65535 * np.clip(linear_to_srgb(light), 0, 1), np.uint16)
