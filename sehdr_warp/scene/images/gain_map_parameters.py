"""Read metadata of gain maps: Ultra HDR's XMP, ISO 21496-1's binary metadata, and Apple's maker note."""

import io
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import TiffImagePlugin

from .xmp import xmp_values

MOST_STOPS = 16.0  # Between white and the largest light; encoders state 1 to 6
_NUMBERS = ("minimum", "maximum", "gamma", "base_offset", "alternate_offset")


@dataclass(frozen=True)
class GainMapParameters:
    """Meaning of the pixels of a gain map. Numbers are given for one or three channels, and kept as [3] float64.

    Raises:
        ValueError: for numbers that cannot be, unless base_is_hdr.
    """

    minimum: Any = 0.0  # log2 of the gain that 0 stands for
    maximum: Any = 1.0  # log2 of the gain that 1 stands for
    gamma: Any = 1.0  # Exponent of the encoding
    base_offset: Any = 1 / 64  # Added to the photo's light before it is multiplied
    alternate_offset: Any = 1 / 64  # Subtracted afterwards
    base_is_hdr: bool = False  # The photo itself is the HDR rendition, and gains lead to a darker one
    in_alternate_colors: bool = False  # Gains apply in the primaries of the alternate rendition
    is_apple: bool = False  # The map is encoded by Rec.709's curve, and linear in gain; `maximum` is its headroom

    def __post_init__(self):
        """Make all numbers [3], and check them."""
        for name in _NUMBERS:
            object.__setattr__(self, name, np.resize(np.array(getattr(self, name), np.float64), 3))
        if self.base_is_hdr:
            return
        if not all(np.isfinite(getattr(self, name)).all() for name in _NUMBERS):
            raise ValueError("its parameters are not finite")
        if not ((self.gamma > 0.01) & (self.gamma < 100)).all():
            raise ValueError(f"gamma {self.gamma.tolist()}")
        low, high = self.minimum, self.maximum
        if not (low.min() >= -MOST_STOPS and (low <= high).all() and high.max() <= MOST_STOPS):
            raise ValueError(f"gains from {low.tolist()} to {high.tolist()} stops")
        if not np.abs([self.base_offset, self.alternate_offset]).max() <= 1:
            raise ValueError("offsets above the light of white")


def parameters_of_xmp(xmp: str) -> GainMapParameters:
    """Return the parameters of Ultra HDR's XMP (hdrgm 1.0)."""

    def values(name: str) -> list[str]:
        return xmp_values(xmp, f"hdrgm:{name}")

    def numbers(name: str, default: float) -> tuple[float, ...]:
        floats = tuple(float(value) for value in values(name))
        return floats if len(floats) in (1, 3) else (default,)

    return GainMapParameters(
        minimum=numbers("GainMapMin", 0.0),
        maximum=numbers("GainMapMax", 1.0),
        gamma=numbers("Gamma", 1.0),
        base_offset=numbers("OffsetSDR", 1 / 64),
        alternate_offset=numbers("OffsetHDR", 1 / 64),
        base_is_hdr=[value.lower() for value in values("BaseRenditionIsHDR")[:1]] == ["true"],
    )


def parameters_of_iso(data: bytes) -> GainMapParameters:
    """Return the parameters of ISO 21496-1's binary metadata, from the minimum version on.

    libultrahdr's variant with one denominator for all numbers (flag 8) is read, too. Raises struct.error or ValueError.
    """
    least, _, flags = struct.unpack_from(">HHB", data)
    if least > 0:
        raise ValueError(f"metadata of version {least}")
    channels, at = (3 if flags & 0x80 else 1), 5
    common = struct.unpack_from(">I", data, at)[0] if flags & 8 else None
    at += 4 if common is not None else 0

    def take(signed: bool) -> float:
        nonlocal at
        (numerator,) = struct.unpack_from(">i" if signed else ">I", data, at)
        at += 4
        denominator = common
        if denominator is None:
            (denominator,) = struct.unpack_from(">I", data, at)
            at += 4
        if not denominator:
            raise ValueError("a fraction with denominator 0")
        return numerator / denominator

    base, alternate = take(False), take(False)
    rows = [(take(True), take(True), take(False), take(True), take(True)) for _ in range(channels)]
    minimum, maximum, gamma, base_offset, alternate_offset = zip(*rows, strict=True)
    colors, is_hdr = not flags & 0x40, base > alternate
    return GainMapParameters(minimum, maximum, gamma, base_offset, alternate_offset, is_hdr, colors)


def parameters_of_apple(xmp: str, exif: Any) -> GainMapParameters:
    """Return the headroom of Apple's gain map: from XMP, else from the maker note, by Apple's published formula.

    Raises ValueError if neither states it.
    """
    if headroom_text := xmp_values(xmp, "HDRGainMap:HDRGainMapHeadroom"):
        headroom = float(headroom_text[0])
    else:
        note = _apple_note(exif.get_ifd(0x8769).get(0x927C, b""))
        if 33 not in note or 48 not in note:
            raise ValueError("neither XMP nor maker note states its headroom")
        bright, gain = note[33], note[48]
        if bright < 1:
            stops = -20 * gain + 1.8 if gain <= 0.01 else -0.101 * gain + 1.601
        else:
            stops = -70 * gain + 3.0 if gain <= 0.01 else -0.303 * gain + 2.303
        headroom = 2.0 ** max(stops, 0.0)
    if not 1 < headroom <= 2**MOST_STOPS:
        raise ValueError(f"headroom {headroom:g}")
    return GainMapParameters(maximum=math.log2(headroom), base_offset=0.0, alternate_offset=0.0, is_apple=True)


def _apple_note(note: Any) -> dict[int, float]:
    """Return the fractions of Apple's maker note by tag: a TIFF directory, big-endian, after 14 bytes."""
    if not isinstance(note, bytes) or not note.startswith(b"Apple iOS\0"):
        return {}
    table = TiffImagePlugin.ImageFileDirectory_v2(b"MM\0*\0\0\0\x0e")
    # Places in the note count from its beginning.
    file = io.BytesIO(note)
    file.seek(14)
    table.load(file)
    return {tag: float(table[tag]) for tag in (33, 48) if tag in table}
