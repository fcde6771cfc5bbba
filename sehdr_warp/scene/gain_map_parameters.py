"""Read metadata of gain maps: Ultra HDR's XMP, ISO 21496-1's binary metadata, and Apple's maker note."""

import io
import struct
from dataclasses import dataclass
from typing import Any

from PIL import TiffImagePlugin

from .xmp import xmp_values

MOST_STOPS = 16.0  # Between white and the largest light; encoders state 1 to 6


@dataclass(frozen=True)
class GainMapParameters:
    """Parameters that metadata state: lists of 1 or 3 numbers, by the names of GainMap; apple_headroom is linear."""

    minimum: tuple[float, ...] = (0.0,)
    maximum: tuple[float, ...] = (1.0,)
    gamma: tuple[float, ...] = (1.0,)
    base_offset: tuple[float, ...] = (1 / 64,)
    alternate_offset: tuple[float, ...] = (1 / 64,)
    headroom: float = 1.0
    base_is_hdr: bool = False
    in_alternate_colors: bool = False
    apple_headroom: float | None = None


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
        headroom=numbers("HDRCapacityMax", 1.0)[0],
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
    return GainMapParameters(minimum, maximum, gamma, base_offset, alternate_offset, alternate, is_hdr, colors)


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
    return GainMapParameters(apple_headroom=headroom)


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
