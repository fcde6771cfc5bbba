"""Check the codes of all photos together: that they show something, and use the bits of their files."""

from pathlib import Path

import numpy as np

from ..errors import InputError
from .color.primaries import srgb_to_linear

_MOST_BITS_UNSCALED = 14  # Of sensors, whose codes some programs store in 16 bits as they are
_NEARLY_WHITE = 0.97  # Part of a sensor's range in which its clipped codes end


class ContentCheck:
    """Counts the samples of photos that are neither black nor white. Large photos are sampled on a grid."""

    def __init__(self) -> None:
        """Start without photos."""
        self._visible = self._total = 0
        self._light = 0.0

    def add(self, codes: np.ndarray, mask: np.ndarray | None = None) -> None:
        """Count a photo, [H, W, 3], by about a million of its pixels, of which the mask [H, W] may leave some out."""
        step = max(1, round((codes.shape[0] * codes.shape[1] / 1e6) ** 0.5))
        values, white = codes[::step, ::step], np.iinfo(codes.dtype).max
        values = values if mask is None else values[mask[::step, ::step] > 0.5]
        self._visible += int(((values > white * 1.5 / 255) & (values < white * (1 - 1.5 / 255))).sum())
        self._total += values.size
        self._light += float(values.sum(dtype=np.float64)) / white

    def require_content(self, folder: Path) -> None:
        """Raise InputError, which names the folder, if fewer than one sample in a thousand shows something."""
        if self._total == 0:
            remedy = "masks keep what is white, and transparent photos their opaque pixels"
            raise InputError(folder, "masks or transparency leave out all pixels of the training photos", remedy)
        if self._visible < self._total * 1e-3:
            share, mean = 100 - 100 * self._visible / self._total, self._light / self._total
            state = f"black or white in {share:.1f} % (mean {mean:.3f})"
            remedy = "expose them so that the scene shows, or choose another exposure index"
            raise InputError(folder, f"the training photos are {state}", remedy)


def unused_bits_note(largest: int, *, linear: bool) -> list[str]:
    """Return a note if the largest code of photos with 16 bits is that of fewer bits: white may lie far below 65535.

    Args:
        largest: as the views store it, 0 without such photos.
        linear: the files' codes are proportional to light, and the views' are encoded by sRGB's curve.
    """
    stated = round(float(srgb_to_linear(np.array(largest / 65535))) * 65535) if linear else largest
    bits = stated.bit_length()
    if not 8 < bits <= _MOST_BITS_UNSCALED or stated < _NEARLY_WHITE * 2**bits:
        return []
    note = f"no code of the 16-bit photos is above {stated}: if they hold {bits} bits"
    return [f"{note}, what clips there counts as measured; multiply their codes by {2 ** (16 - bits)}"]
