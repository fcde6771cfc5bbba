"""Check the codes of all photos together: that they show something, and use the bits of their files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from .color.primaries import srgb_to_linear
from .types import View

_MOST_BITS_UNSCALED = 14  # Of sensors, whose codes some programs store in 16 bits as they are
_NEARLY_WHITE = 0.97  # Part of a sensor's range in which its clipped codes end


def require_content(views: Sequence[View], folder: Path) -> None:
    """Raise InputError, which names the folder, if hardly a sample of the photos shows something: one in 1000.

    Large photos are sampled on a grid, at about a million of their pixels.
    """
    visible, total, light = 0, 0, 0.0
    for view in views:
        step = max(1, round((view.codes.shape[0] * view.codes.shape[1] / 1e6) ** 0.5))
        values, white = view.codes[::step, ::step], view.levels
        values = values if view.mask is None else values[view.mask[::step, ::step] > 0.5]
        visible += int(((values > white * 1.5 / 255) & (values < white * (1 - 1.5 / 255))).sum())
        total += values.size
        light += float(values.sum(dtype=np.float64)) / white
    if total == 0:
        remedy = "masks keep what is white, and transparent photos their opaque pixels"
        raise InputError(folder, "masks or transparency leave out all pixels of the training photos", remedy)
    if visible < total * 1e-3:
        state = f"black or white in {100 - 100 * visible / total:.1f} % (mean {light / total:.3f})"
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
