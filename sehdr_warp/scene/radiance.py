"""Radiance (.hdr) pictures: shared-exponent RGBE pixels, flat or run-length coded (Ward, Graphics Gems II, II.5)."""

import re
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import read_bytes

_REMEDY = "export the image again"
_MAX_HEADER_BYTES = 1 << 16


def radiance_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header alone; raises InputError where it is no Radiance picture."""
    if not path.is_file():
        raise InputError(path, "image file not found", "check the data folder")
    with path.open("rb") as file:
        return _header(file.read(_MAX_HEADER_BYTES), path)[:2]


def read_radiance(path: Path) -> np.ndarray:
    """[H, W, 3] float32 linear RGB, scaled by the header's EXPOSURE lines (radiance = pixel / exposure).

    The caller bounds the size first (radiance_size). Raises InputError where the file is damaged or ends early.
    """
    data = read_bytes(path)
    width, height, start, exposure = _header(data[:_MAX_HEADER_BYTES], path)
    codes = np.frombuffer(data, np.uint8)
    rgbe = np.empty((height, width, 4), np.uint8)
    position = start
    for row in range(height):
        position = _read_row(codes, position, rgbe[row], path, row)
    scale = np.ldexp(1.0, rgbe[..., 3].astype(np.int32) - 136)
    pixels = (rgbe[..., :3] + 0.5) * scale[..., None] / exposure
    pixels[rgbe[..., 3] == 0] = 0.0
    return pixels.astype(np.float32)


def _header(data: bytes, path: Path) -> tuple[int, int, int, float]:
    """Width, height, where the pixels begin, and the product of the exposures."""
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")):
        raise InputError(path, "is not a Radiance picture", _REMEDY)
    end = data.find(b"\n\n")
    size = re.compile(rb"-Y (\d{1,6}) \+X (\d{1,6})\n").match(data, end + 2) if end >= 0 else None
    if size is None:
        raise InputError(path, "Radiance header has no '-Y height +X width' line", _REMEDY)
    header = data[:end]
    if b"32-bit_rle_xyze" in header:
        raise InputError(path, "holds XYZ colours, not RGB", "convert it to RGB (ra_xyze -r)")
    exposure = 1.0
    for value in re.findall(rb"^EXPOSURE\s*=\s*([^\s]{1,40})", header, re.MULTILINE):
        try:
            exposure *= float(value)
        except ValueError:
            exposure = np.nan
    if not (np.isfinite(exposure) and exposure > 0):
        raise InputError(path, "EXPOSURE is not a positive number", _REMEDY)
    return int(size[2]), int(size[1]), size.end(), exposure


def _read_row(codes: np.ndarray, position: int, row: np.ndarray, path: Path, index: int) -> int:
    """Fill one row [W, 4] from codes[position:]; returns where the next row begins."""
    width = len(row)
    ended = InputError(path, f"pixel data is damaged or ends early in row {index}", _REMEDY)
    if position + 4 > len(codes):
        raise ended
    first = codes[position : position + 4]
    if first[0] != 2 or first[1] != 2 or first[2] & 0x80 or not 8 <= width < 32768:
        flat = codes[position : position + 4 * width]
        if len(flat) < 4 * width:
            raise ended
        row[:] = flat.reshape(width, 4)
        return position + 4 * width
    if int(first[2]) << 8 | int(first[3]) != width:
        raise ended
    position += 4
    for channel in range(4):
        filled = 0
        while filled < width:
            if position + 2 > len(codes):
                raise ended
            count = int(codes[position])
            if count > 128:
                count, values, step = count - 128, codes[position + 1], 2
            else:
                values, step = codes[position + 1 : position + 1 + count], 1 + count
                if len(values) < count:
                    raise ended
            if count == 0 or filled + count > width:
                raise ended
            row[filled : filled + count, channel] = values
            filled += count
            position += step
    return position
