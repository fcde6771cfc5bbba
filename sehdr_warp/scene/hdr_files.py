"""Scene-linear pixels from OpenEXR and Radiance files (shared-exponent RGBE; Ward, Graphics Gems II, II.5)."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import read_bytes
from ..quiet import silent_output
from .images import DAMAGED, MAX_PIXELS, check_size, require_file

# OpenEXR asks for the memory of all pixels before it reads one. Its ZIP of a single color holds 500 pixels in a byte.
_MOST_PIXELS_PER_BYTE = 4096
_REMEDY = "export the image again"
_MAX_HEADER_BYTES = 1 << 16


def hdr_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header alone; InputError where it cannot be read or states too many pixels."""
    if path.suffix.lower() != ".hdr":
        return _exr_window(path, MAX_PIXELS)[1]
    require_file(path)
    with path.open("rb") as file:
        size = _radiance_header(file.read(_MAX_HEADER_BYTES), path)[:2]
    check_size(path, *size)
    return size


def read_hdr(path: Path) -> np.ndarray:
    """[H, W, 3] float32 scene-linear radiance; negative values are raised to zero.

    Raises InputError where the file is missing, damaged or too large, or a value is NaN or infinite (with its place).
    """
    if path.suffix.lower() == ".hdr":
        hdr_size(path)
        pixels = _read_radiance(path)
    else:
        channels, _ = read_exr_channels(path)
        names = next((names for names in ("RGB", "rgb", "YYY", "VVV") if set(names) <= set(channels)), None)
        if names is None:
            found = f"has the channels {sorted(channels)[:8]}, not R, G, B"
            raise InputError(path, found, "export it with color channels")
        pixels = np.stack([channels[name] for name in names], axis=2)
    bad = ~np.isfinite(pixels)
    if bad.any():
        row, column, channel = (int(i) for i in np.argwhere(bad)[0])
        place = f"one {'RGB'[channel]} = {pixels[row, column, channel]} at x={column}, y={row}"
        raise InputError(path, f"{int(bad.any(axis=2).sum())} pixels not finite, {place}", _REMEDY)
    return np.maximum(pixels, 0.0)


def read_exr_channels(path: Path, *, max_pixels: int = MAX_PIXELS) -> tuple[dict[str, np.ndarray], dict]:
    """The channels of an OpenEXR file's first part, each [H, W] float32 over the display window, and its header.

    Pixels of the display window outside the data window are 0. Values are as stored: NaN and infinity pass.
    Raises InputError where the file is missing, damaged, truncated or holds more than max_pixels pixels.
    """
    origin, (width, height) = _exr_window(path, max_pixels)
    with _exr_file(path, separate_channels=True) as file:
        # A file whose pixels end early leaves no part behind instead of raising.
        if not file.parts:
            raise InputError(path, "pixel data is damaged or ends early", DAMAGED)
        header = dict(file.header())
        stored = {name: channel.pixels for name, channel in file.channels().items()}
    left, top = (int(a) - b for a, b in zip(header["dataWindow"][0], origin, strict=True))
    channels = {}
    for name, pixels in stored.items():
        if pixels is not None and pixels.ndim == 2:
            shown = pixels[max(-top, 0) : max(height - top, 0), max(-left, 0) : max(width - left, 0)]
            channels[name] = np.zeros((height, width), np.float32)
            channels[name][max(top, 0) :, max(left, 0) :][: shown.shape[0], : shown.shape[1]] = shown
    return channels, header


@contextmanager
def _exr_file(path: Path, **options) -> Iterator:
    import OpenEXR

    require_file(path)
    try:
        with silent_output(), OpenEXR.File(str(path), **options) as file:
            yield file
    except (RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise InputError(path, f"cannot be read as OpenEXR ({error})", DAMAGED) from None


def _exr_window(path: Path, max_pixels: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The display window's origin and its (width, height)."""
    with _exr_file(path, header_only=True) as file:
        header = file.header()
        windows = [[(int(x), int(y)) for x, y in header[key]] for key in ("displayWindow", "dataWindow")]
    sizes = [(high[0] - low[0] + 1, high[1] - low[1] + 1) for low, high in windows]
    stored = path.stat().st_size
    for size in sizes:
        check_size(path, *size, max_pixels)
        if size[0] * size[1] > _MOST_PIXELS_PER_BYTE * stored:
            raise InputError(path, f"states {size[0]} x {size[1]} pixels, but has only {stored} bytes", DAMAGED)
    return windows[0][0], sizes[0]


def _read_radiance(path: Path) -> np.ndarray:
    """[H, W, 3] float32 linear RGB, scaled by the header's EXPOSURE lines (radiance = pixel / exposure)."""
    data = read_bytes(path)
    width, height, position, exposure = _radiance_header(data[:_MAX_HEADER_BYTES], path)
    rgbe = np.empty((height, width, 4), np.uint8)
    for row in range(height):
        try:
            rgbe[row], position = _read_row(data, position, width)
        except (IndexError, ValueError):
            raise InputError(path, f"pixel data is damaged or ends early in row {row}", _REMEDY) from None
    scale = np.ldexp(1.0, rgbe[..., 3].astype(np.int32) - 136)
    pixels = (rgbe[..., :3] + 0.5) * scale[..., None] / exposure
    pixels[rgbe[..., 3] == 0] = 0.0
    return pixels.astype(np.float32)


def _radiance_header(data: bytes, path: Path) -> tuple[int, int, int, float]:
    """Width, height, where the pixels begin, and the product of the exposures."""
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")):
        raise InputError(path, "is not a Radiance picture", _REMEDY)
    end = data.find(b"\n\n")
    size = re.compile(rb"-Y (\d{1,6}) \+X (\d{1,6})\n").match(data, end + 2) if end >= 0 else None
    if size is None:
        raise InputError(path, "Radiance header has no '-Y height +X width' line", _REMEDY)
    if b"32-bit_rle_xyze" in data[:end]:
        raise InputError(path, "holds XYZ colors, not RGB", "convert it to RGB (ra_xyze -r)")
    try:
        stated = re.findall(rb"^EXPOSURE\s*=\s*([^\s]{1,40})", data[:end], re.MULTILINE)
        exposure = float(np.prod([float(value) for value in stated]))
    except ValueError:
        exposure = np.nan
    if not (np.isfinite(exposure) and exposure > 0):
        raise InputError(path, "EXPOSURE is not a positive number", _REMEDY)
    return int(size[2]), int(size[1]), size.end(), exposure


def _read_row(data: bytes, position: int, width: int) -> tuple[np.ndarray, int]:
    """A row [W, 4], flat or run-length coded, and where the next begins; IndexError or ValueError where damaged."""
    first = data[position : position + 4]
    if first[:2] != b"\2\2" or first[2] & 0x80 or not 8 <= width < 32768:
        end = position + 4 * width
        return np.frombuffer(data[position:end], np.uint8).reshape(width, 4), end
    if int.from_bytes(first[2:], "big") != width:
        raise ValueError
    position, planes = position + 4, bytearray()
    while len(planes) < 4 * width:
        count = data[position]
        if count > 128:
            planes += data[position + 1 : position + 2] * (count - 128)
            position += 2
        else:
            planes += data[position + 1 : position + 1 + count]
            position += 1 + count
    return np.frombuffer(planes, np.uint8).reshape(4, width).T, position
