"""Check the codes of all photos together: that they show something, fill their frame, and use their files' bits."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..subsets import every_nth
from .color.primaries import srgb_to_linear
from .images.ldr_files import LDR_SUFFIXES, PILLOW_ERRORS, grey_thumbnail
from .types import View

_MOST_BITS_UNSCALED = 14  # Of sensors, whose codes some programs store in 16 bits as they are
_NEARLY_WHITE = 0.97  # Part of a sensor's range in which its clipped codes end
_JUDGED, _SIDE = 8, 128  # Photos that are looked at for a circle, and the side of their thumbnails
_BLACK, _SHOWN = 24, 40  # Codes outside and inside the circle of a fisheye lens; of one such set 2 and 111


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
    highest = round(float(srgb_to_linear(np.array(largest / 65535))) * 65535) if linear else largest
    bits = highest.bit_length()
    if not 8 < bits <= _MOST_BITS_UNSCALED or highest < _NEARLY_WHITE * 2**bits:
        return []
    note = f"no code of the 16-bit photos is above {highest}: if they hold {bits} bits"
    return [f"{note}, what clips there counts as measured; multiply their codes by {2 ** (16 - bits)}"]


def frame_notes(photos: Sequence[Path], *, masked: bool = False) -> tuple[str, ...]:
    """Return notes if bare photos are circles in black frames, or have bars at their edges and are not `masked`.

    Structure from motion does not know the lens of the one, and the other would become part of the scene.
    """
    if any(photo.suffix.lower() not in LDR_SUFFIXES for photo in photos):
        return ()
    try:
        pictures = [grey_thumbnail(photo, _SIDE) for photo in every_nth(photos, _JUDGED)]
    except (InputError, *PILLOW_ERRORS):
        return ()  # The readers of these photos report what is wrong with them.
    outside, inside = np.median([_around_circle(codes) for codes in pictures], axis=0)
    if outside < _BLACK and inside >= _SHOWN:
        note = "photos are circles in black frames, as of a fisheye lens, but their cameras are found as of a usual"
        return (f"{note} lens: bring cameras of COLMAP's OPENCV_FISHEYE, or convert the photos to usual ones",)
    sides = {"top": 0, "right": 1, "bottom": 2, "left": 3}  # Quarter turns that bring a side to the top
    for color, codes in () if masked else (("black", pictures), ("white", [255 - each for each in pictures])):
        if bars := [side for side, turns in sides.items() if _have_bars([np.rot90(each, turns) for each in codes])]:
            note = f"photos have {color} bars ({', '.join(bars)}), which become part of the scene"
            return (f"{note}: crop them off, or leave them out by a mask.png that is black there",)
    return ()


def _around_circle(codes: np.ndarray) -> tuple[float, float]:
    """Return nearly the brightest code outside the largest circle in a photo, and nearly the darkest just inside."""
    if min(codes.shape) < _SIDE / 8:
        return 255.0, 0.0
    rows, columns = (np.arange(side) - (side - 1) / 2 for side in codes.shape)
    radius = np.hypot(rows[:, None], columns) / (min(codes.shape) / 2)
    ring = (radius > 0.8) & (radius < 0.92)
    return float(np.percentile(codes[radius > 1.08], 95)), float(np.percentile(codes[ring], 20))


def _have_bars(pictures: Sequence[np.ndarray]) -> bool:
    """Return whether the first rows of all pictures are black, equally many, and the next row of most is not.

    The ground around an object ends elsewhere in each picture, and nowhere along a whole row.
    """
    edges = [int(np.argmax(np.percentile(codes, 98, axis=1) >= _BLACK)) for codes in pictures]
    if min(edges) < _SIDE / 32 or max(edges) > min(edges) + 1:
        return False
    beyond = [np.percentile(codes[edge:][:2][-1], 20) for codes, edge in zip(pictures, edges, strict=True)]
    return float(np.median(beyond)) >= _SHOWN
