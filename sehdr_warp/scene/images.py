"""Pixels from files: PNG (8 and 16 bits), JPEG, TIFF, WebP, OpenEXR and Radiance, with sizes known before decoding."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import InputError
from ..quiet import silent_stderr
from .radiance import radiance_size, read_radiance

# Far above any single camera frame (the largest medium-format backs give 151 megapixels) and far below what would
# exhaust memory; Pillow on its own only warns, and OpenEXR has no limit.
MAX_PIXELS = 160_000_000

# OpenEXR asks for the memory of all pixels before it reads one. Its ZIP of a single colour holds 500 pixels in a byte.
MOST_PIXELS_PER_BYTE = 4096

LDR_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
HDR_SUFFIXES = (".exr", ".hdr")

_ORIENTATION_TAG = 0x0112
_DAMAGED = "copy or export the image again"


@dataclass(frozen=True)
class EncodedImage:
    """A decoded LDR photo.

    pixels: [H, W, 3] uint8 or uint16, the stored code values.
    alpha: [H, W] float32 in [0, 1], or None for an opaque image.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None

    @property
    def levels(self) -> int:
        """The largest code value: 255 or 65535."""
        return int(np.iinfo(self.pixels.dtype).max)


def image_sizes(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """The image's size in its file and after its EXIF orientation, each (width, height), from the header alone.

    Raises InputError where the file is missing, is no image, or holds more than MAX_PIXELS pixels.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        size = _exr_window(path)[1]
        return size, size
    if suffix == ".hdr":
        size = radiance_size(path)
        _check_size(path, *size)
        return size, size
    with open_image(path) as image:
        turned = _orientation(image) in (5, 6, 7, 8)
        return image.size, image.size[::-1] if turned else image.size


def read_ldr(path: Path, *, oriented: bool = False) -> EncodedImage:
    """Decode a PNG, JPEG, TIFF, WebP or BMP file; 16-bit files keep their 16 bits, palettes and grey become RGB.

    oriented: turn the pixels as the EXIF orientation says.
    Raises InputError where the file is missing, damaged, truncated, of another kind, or larger than MAX_PIXELS.
    """
    with open_image(path) as image:
        try:
            pixels, alpha = _decode(image, path)
            turn = _turn(image) if oriented else None
        except InputError:
            raise
        except (OSError, SyntaxError, ValueError, EOFError, MemoryError, Image.DecompressionBombError) as error:
            raise InputError(path, f"cannot be decoded ({error})", _DAMAGED) from None
    if turn is not None:
        pixels, alpha = turn(pixels), None if alpha is None else turn(alpha)
    return EncodedImage(np.ascontiguousarray(pixels), None if alpha is None else np.ascontiguousarray(alpha))


def read_mask(path: Path, *, oriented: bool = False) -> np.ndarray:
    """[H, W] float32 in [0, 1] from grey, colour (its mean) or transparent (its alpha); 1 counts."""
    image = read_ldr(path, oriented=oriented)
    if image.alpha is not None:
        return image.alpha
    return (image.pixels.mean(axis=2) / image.levels).astype(np.float32)


def read_hdr(path: Path, *, keep_negative: bool = False) -> np.ndarray:
    """[H, W, 3] float32 scene-linear radiance from an OpenEXR or Radiance file; negative values are raised to zero
    unless they are to be kept.

    Raises InputError where the file is missing, damaged or too large, or a value is NaN or infinite (with its place).
    """
    if path.suffix.lower() == ".hdr":
        _check_size(path, *radiance_size(path))
        pixels = read_radiance(path)
    else:
        channels, _ = read_exr_channels(path)
        names = next(
            (n for n in (("R", "G", "B"), ("r", "g", "b"), ("Y",) * 3, ("V",) * 3) if set(n) <= set(channels)), None
        )
        if names is None:
            raise InputError(
                path, f"has the channels {sorted(channels)[:8]}, not R, G, B", "export it with colour channels"
            )
        pixels = np.stack([channels[name] for name in names], axis=2)
    bad = ~np.isfinite(pixels)
    if bad.any():
        row, column, channel = (int(i) for i in np.argwhere(bad)[0])
        value = pixels[row, column, channel]
        raise InputError(
            path,
            f"{int(bad.any(axis=2).sum())} pixels not finite, one {'RGB'[channel]} = {value} at x={column}, y={row}",
            "render or export the image again",
        )
    return pixels if keep_negative else np.maximum(pixels, 0.0)


def read_exr_channels(path: Path, *, max_pixels: int = MAX_PIXELS) -> tuple[dict[str, np.ndarray], dict]:
    """The channels of an OpenEXR file's first part, each [H, W] float32 over the display window, and its header.

    Pixels of the display window outside the data window are 0. Values are as stored: NaN and infinity pass.
    Raises InputError where the file is missing, damaged, truncated or holds more than max_pixels pixels.
    """
    import OpenEXR

    (x0, y0), (width, height) = _exr_window(path, max_pixels)
    try:
        with silent_stderr(), OpenEXR.File(str(path), separate_channels=True) as file:
            # A file whose pixels end early leaves no part behind instead of raising.
            if not file.parts:
                raise InputError(path, "pixel data is damaged or ends early", _DAMAGED)
            header = dict(file.header())
            stored = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise InputError(path, f"cannot be read as OpenEXR ({error})", _DAMAGED) from None
    (data_x, data_y), _ = (tuple(int(v) for v in corner) for corner in header["dataWindow"])
    channels = {}
    for name, pixels in stored.items():
        if pixels is None or pixels.ndim != 2:
            continue
        full = np.zeros((height, width), np.float32)
        top, left = data_y - y0, data_x - x0
        rows = slice(max(top, 0), min(top + pixels.shape[0], height))
        columns = slice(max(left, 0), min(left + pixels.shape[1], width))
        if rows.start < rows.stop and columns.start < columns.stop:
            full[rows, columns] = pixels[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
        channels[name] = full
    return channels, header


def _exr_window(path: Path, max_pixels: int = MAX_PIXELS) -> tuple[tuple[int, int], tuple[int, int]]:
    """The display window's origin and its (width, height)."""
    import OpenEXR

    _require_file(path)
    try:
        with silent_stderr(), OpenEXR.File(str(path), header_only=True) as file:
            header = file.header()
            windows = [
                [tuple(int(v) for v in corner) for corner in header[key]] for key in ("displayWindow", "dataWindow")
            ]
    except (RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise InputError(path, f"cannot be read as OpenEXR ({error})", _DAMAGED) from None
    sizes = [(high[0] - low[0] + 1, high[1] - low[1] + 1) for low, high in windows]
    stored = path.stat().st_size
    for size in sizes:
        _check_size(path, *size, max_pixels)
        if size[0] * size[1] > MOST_PIXELS_PER_BYTE * stored:
            raise InputError(path, f"states {size[0]} x {size[1]} pixels, but has only {stored} bytes", _DAMAGED)
    return windows[0][0], sizes[0]


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise InputError(path, "image file not found", "check the data folder")
    if path.stat().st_size == 0:
        raise InputError(path, "image file is empty", _DAMAGED)


def _check_size(path: Path, width: int, height: int, max_pixels: int = MAX_PIXELS) -> None:
    if width < 1 or height < 1 or width * height > max_pixels:
        raise InputError(
            path, f"size {width} x {height} is not between 1 and {max_pixels} pixels", "scale the image down"
        )


def open_image(path: Path) -> Image.Image:
    """The image with its header read and its pixels not; InputError as image_sizes raises it."""
    _require_file(path)
    # Pillow's own limit is global and lower for its warning; ours is checked below, before any pixel is decoded.
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        image = Image.open(path)
    except (OSError, SyntaxError, ValueError, EOFError, MemoryError) as error:
        detail = "" if "cannot identify" in str(error) else f" ({error})"
        raise InputError(path, f"is not a readable image{detail}", _DAMAGED) from None
    finally:
        Image.MAX_IMAGE_PIXELS = limit
    try:
        _check_size(path, *image.size)
    except InputError:
        image.close()
        raise
    return image


def _decode(image: Image.Image, path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Code values [H, W, 3] and alpha [H, W] in [0, 1] or None."""
    if image.mode in ("RGB", "RGBA") and (low := _low_byte_tiles(image)):
        with Image.open(path) as second:
            second.tile = low
            low_bytes = np.asarray(second)
        return _split(np.asarray(image).astype(np.uint16) << 8 | low_bytes)
    if image.mode.startswith("I;16"):
        return _split(np.asarray(image).astype(np.uint16))
    if image.mode == "I":
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 65535:
            raise InputError(
                path, f"32-bit values up to {int(values.max())} have no known white", "export it with 16 bits"
            )
        return _split(values.astype(np.uint16))
    if image.mode == "F":
        raise InputError(path, "holds floating-point values, not encoded ones", "export it as PNG or JPEG")
    transparent = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
    return _split(np.asarray(image.convert("RGBA" if transparent else "RGB")))


def _split(values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    if values.ndim == 2:
        return np.repeat(values[:, :, None], 3, axis=2), None
    if values.shape[2] == 3:
        return values, None
    alpha = values[:, :, 3]
    white = np.iinfo(values.dtype).max
    return values[:, :, :3], None if alpha.min() == white else (alpha / np.float32(white)).astype(np.float32)


def _low_byte_tiles(image: Image.Image) -> list | None:
    """Pillow keeps the high byte of 16-bit colour; asking for the other byte order makes it keep the low one."""
    swapped = "16B" if np.little_endian else "16L"
    other = {"16B": "16L", "16L": "16B", "16N": swapped}
    tiles = []
    for tile in image.tile:
        raw = tile.args if isinstance(tile.args, str) else tile.args[0] if tile.args else ""
        layout, _, depth = str(raw).partition(";")
        if layout not in ("RGB", "RGBA") or depth not in other:
            return None
        mode = f"{layout};{other[depth]}"
        tiles.append(tile._replace(args=mode if isinstance(tile.args, str) else (mode, *tile.args[1:])))
    return tiles or None


def _turn(image: Image.Image):
    """A function that turns [H, W, ...] arrays as the EXIF orientation says."""
    turns = {
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: a.swapaxes(0, 1)[:, ::-1],
        7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
        8: lambda a: a.swapaxes(0, 1)[::-1],
    }
    return turns.get(_orientation(image))


def _orientation(image: Image.Image) -> int:
    """EXIF's orientation, 1 (as stored) where there is none or EXIF is damaged: the pixels may still be good."""
    try:
        return image.getexif().get(_ORIENTATION_TAG, 1)
    except (OSError, SyntaxError, ValueError, KeyError, TypeError, EOFError, MemoryError, struct.error):
        return 1
