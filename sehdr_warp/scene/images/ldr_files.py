"""Readers of LDR images: PNG (8 and 16 bits), JPEG, TIFF, WebP and BMP, with sizes checked before decoding.

All images are opened by open_image. The content decides the format, whatever the name says, and only these formats are
decoded: Pillow knows many more, and passes some (EPS) to other programs.
"""

import re
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageFile

from ...errors import InputError
from ...quiet import silent_stderr
from .heif import HEIF_SUFFIXES, heif_installed, is_heif, read_deep_heif, register_heif
from .tiff import BIG_ENDIAN, describe_tiff, has_planes_of_16_bits, has_thumbnails, read_planes, whole_range

MAX_PIXELS = 160_000_000
"""Above the frame of any camera (the largest backs have 151 megapixels), far below what would exhaust memory."""
MAX_SIDE = 65_536  # No photo has a longer side; a damaged one with few pixels in all would take long to decode
JPEG_SUFFIXES = (".jpg", ".jpeg", ".jfif", ".jpe", ".mpo")
LDR_SUFFIXES = (
    ".png", *JPEG_SUFFIXES, ".tif", ".tiff", ".webp", ".bmp", ".avif", *HEIF_SUFFIXES * heif_installed(),
)  # fmt: skip
"""HEIF's among them if the package that decodes it is installed."""
HDR_SUFFIXES = (".exr", ".hdr")
RAW_SUFFIXES = (
    ".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".rw2", ".rwl", ".orf", ".pef", ".srw",
    ".3fr", ".fff", ".iiq", ".mos", ".mef", ".erf", ".mrw", ".dcr", ".kdc", ".k25",
)  # fmt: skip
PHOTO_SUFFIXES = (*LDR_SUFFIXES, *RAW_SUFFIXES, *HDR_SUFFIXES)
_BAND_ROWS = 512
_BLOCK, _AROUND, _LEAST_WHITE, _NEAR_WHITE = 8, 3, 0.1, 250
"""Codes of a photo that rounds colors are white from _NEAR_WHITE, if this part of their channel is in the _AROUND x
_AROUND blocks around them."""
_opening = threading.Lock()  # Pillow's pixel limit, which is lifted while opening, is shared by all threads
_ROUNDS_COLORS = "JPEG", "MPO", "HEIF", "AVIF"  # Store colors coarser than brightness, as lossy WebP, with 220 levels
_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "AVIF")
_MODES = ("L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "I", "I;16", "I;16L", "I;16B", "I;16N")
_OTHER_MODES = {
    "1": "one bit a pixel, black or white", "CMYK": "inks (CMYK), not light", "LAB": "CIELAB, not RGB",
    "F": "floating-point values, not encoded ones",
}  # fmt: skip
DAMAGED = "copy or export the image again"
_EXPORT = "export it as RGB or grey, in PNG or JPEG"
_SIGNATURES = {
    b"\xff\x0a": "JPEG XL", b"\0\0\0\x0cJXL ": "JPEG XL", b"\0\0\0\x0cjP  ": "JPEG 2000", b"GIF8": "a GIF",
    b"II\xbc": "JPEG XR",
    b"8BPS": "a Photoshop file", b"v/1\x01": "OpenEXR", b"#?R": "a Radiance picture", b"%PDF": "a PDF",
    b"<!DOCTYPE": "a web page", b"<html": "a web page", b"version https://git-lfs": "a Git LFS pointer",
}  # fmt: skip
_REMEDIES = {
    "OpenEXR": "name it .exr", "a Radiance picture": "name it .hdr",
    "a Git LFS pointer": "fetch it with `git lfs pull`", "a web page": "download the photo again",
    "a TIFF of floats": "export it with 16 bits, or as OpenEXR", BIG_ENDIAN: "save it as TIFF of less than 4 GB",
}  # fmt: skip
"""Remedies for files of other kinds, where exporting them is not the remedy."""
PILLOW_ERRORS = (
    ArithmeticError, AttributeError, EOFError, Image.DecompressionBombError, LookupError, MemoryError, OSError,
    RuntimeError, SyntaxError, TypeError, ValueError, struct.error,
)  # fmt: skip
"""Exceptions that Pillow raises for damaged files. If it does so for EXIF, the pixels may still be good."""


@dataclass(frozen=True)
class EncodedImage:
    """The codes of a photo, and what its file states beside them."""

    pixels: np.ndarray  # [H, W, 3] uint8 or uint16, the stored codes
    alpha: np.ndarray | None  # [H, W] float32 in [0, 1]; None if all is opaque
    above_white: np.ndarray | None = None  # [H, W, 3] float16, light over white's; 0 if unknown. None if not stated
    above_white_deviation: float = 0.0  # Standard deviation of the natural logarithm of above_white
    white_from: int | None = None  # Least code of white if its format rounds colors, see with_whole_white()

    @property
    def levels(self) -> int:
        """The largest code: 255 or 65535."""
        return int(np.iinfo(self.pixels.dtype).max)


def file_kind(path: Path) -> str:
    """Return raw, float or encoded, by the suffix."""
    suffix = path.suffix.lower()
    return "raw" if suffix in RAW_SUFFIXES else "float" if suffix in HDR_SUFFIXES else "encoded"


def image_sizes(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the photo's size as stored and after its EXIF orientation, each (width, height); raises as open_image."""
    with open_image(path) as image:
        width, height = image.size
        return image.size, (height, width) if orientation_of(image) in (5, 6, 7, 8) else image.size


def read_ldr(path: Path, *, oriented: bool = False, mask: bool = False) -> EncodedImage:
    """Decode a photo; 16-bit files keep their 16 bits, palettes and grey become RGB.

    `oriented` turns the pixels as the EXIF orientation says; `mask` accepts one bit per pixel.

    Raises:
        InputError: if the file is missing, damaged, truncated, of another kind, or larger than MAX_PIXELS.
    """
    with open_image(path, mask=mask) as image:
        try:
            # libtiff prints of what it cannot decode.
            with silent_stderr() if image.format == "TIFF" else nullcontext():
                file_orientation = orientation_of(image) if image.format == "TIFF" else 1
                pixels, alpha = _decode(image, path)
            turn = turn_of_loaded(image, file_orientation, oriented=oriented)
            white_from = 254 if _is_lossy_webp(path) else 255 if image.format in _ROUNDS_COLORS else None
        except PILLOW_ERRORS as error:
            raise InputError(path, f"cannot be decoded ({error})", DAMAGED) from None
    alpha = None if alpha is None else turn_upright(alpha, turn)
    return EncodedImage(turn_upright(pixels, turn), alpha, white_from=white_from)


def _is_lossy_webp(path: Path) -> bool:
    """Return whether a file is a WebP with a lossy chunk of pixels; chunks of its profile and alpha stand before it."""
    with path.open("rb") as file:
        is_webp = file.read(12)[8:] == b"WEBP"
        while is_webp and len(head := file.read(8)) == 8:
            kind, length = struct.unpack("<4sI", head)
            if kind in (b"VP8 ", b"VP8L"):
                return kind == b"VP8 "
            file.seek(length + length % 2, 1)
    return False


def with_whole_white(codes: np.ndarray, white_from: int) -> np.ndarray:
    """Return the codes [H, W, 3] of 8 bits of a photo, in which those are white that its compression made darker.

    It rounds colors, so up to half of the values of a lamp that clips in one channel have a code below 255. Each would
    hold the lamp at white, against darker photos.
    """
    white = codes >= white_from
    if not white.any():
        return codes
    height, width, _ = codes.shape
    padded = np.pad(white, ((0, -height % _BLOCK), (0, -width % _BLOCK), (0, 0)))
    rows, columns = padded.shape[0] // _BLOCK, padded.shape[1] // _BLOCK
    counts = padded.reshape(rows, _BLOCK, columns, _BLOCK, 3).sum((1, 3), dtype=np.int32)
    counts = np.pad(counts, ((_AROUND // 2,) * 2, (_AROUND // 2,) * 2, (0, 0)))
    around = [counts[i : i + rows, j : j + columns] for i in range(_AROUND) for j in range(_AROUND)]
    near = np.sum(around, axis=0) >= _LEAST_WHITE * (_AROUND * _BLOCK) ** 2
    near = near.repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1)[:height, :width]
    return np.where(near & (codes >= _NEAR_WHITE), np.uint8(255), codes)


def grey_thumbnail(path: Path, side: int) -> np.ndarray:
    """Return grey 8-bit codes [h, w] of a photo as it is stored, at most `side` pixels long; raises as Pillow does."""
    with open_image(path) as image:
        image.draft("L", (2 * side, 2 * side))
        small = image.convert("L")
        small.thumbnail((side, side), Image.Resampling.BOX)
        return np.asarray(small)


def has_16_bits(path: Path) -> bool:
    """Return whether a photo that read_ldr decodes has 16 bits; raises as open_image."""
    with open_image(path) as image:
        deep = image.mode.startswith("I") or _is_grey_alpha_of_16_bits(image) or bool(_byte_tiles(image))
        return deep or has_planes_of_16_bits(image)


def open_image(path: Path, *, mask: bool = False) -> ImageFile.ImageFile:
    """Open an image and read its header, not its pixels; `mask` accepts one bit per pixel.

    Of a stereo pair or a photo with a gain map (MPO) it is the first image.

    Raises:
        InputError: if the file is missing, not an image, too large, an animation or several pages, or not grey or RGB.
    """
    require_file(path)
    if heif := is_heif(path):
        register_heif(path)
    # Pillow's own limit is global and lower for its warning; ours is checked below, before any pixel is decoded.
    with _opening:
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            image = Image.open(path, formats=("HEIF",) if heif else _FORMATS)
            several = getattr(image, "is_animated", False) and image.format != "MPO" and not has_thumbnails(image)
        except PILLOW_ERRORS as error:
            if kind := kind_by_content(path):
                problem = f"is {kind}, which is not read as a photo"
                raise InputError(path, problem, remedy_for_kind(kind)) from None
            kinds = f", which is one of {', '.join(_FORMATS)}" * (not heif)
            detail = kinds if "cannot identify" in str(error) else f" ({error})"
            raise InputError(path, f"is not a readable {'HEIC photo' if heif else 'image'}{detail}", DAMAGED) from None
        finally:
            Image.MAX_IMAGE_PIXELS = limit
    mode = image.mode
    try:
        if image.format == "TIFF":
            if (image.tag_v2.get(262), image.tag_v2.get(259)) == (6, 1):  # pyright: ignore[reportAttributeAccessIssue]
                mode = "YCbCr"  # Pillow 11 says RGB.
            # Pillow turns a TIFF upright when it loads it, and states that size before, by which it misreads grey.
            image._size = tuple(image.tag_v2[tag] for tag in (256, 257))  # pyright: ignore[reportAttributeAccessIssue]
        check_size(path, *image.size)
        if several:
            raise InputError(path, "holds several pictures, pages or an animation", "save the one that counts")
        if mode not in (*_MODES, *("1" * mask)):
            raise InputError(path, f"holds {_OTHER_MODES.get(mode, f'{mode}, not RGB')}", _EXPORT)
    except InputError:
        image.close()
        raise
    return image


def kind_by_content(path: Path) -> str | None:
    """Return in words what a file is that Pillow does not read, None if it is not known."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    for signature, kind in _SIGNATURES.items():
        if head.startswith(signature):
            return kind
    if head[:2] == b"\xff\xd8" and (frame := re.search(rb"\xff([\xc0-\xc3])\0.([\x08-\x10])", head, re.DOTALL)):
        lossless, bits = frame[1] == b"\xc3", frame[2][0]
        return "a lossless JPEG" if lossless else "a JPEG of 12 bits" if bits == 12 else None
    with suppress(*PILLOW_ERRORS):
        return describe_tiff(path)
    return None


def remedy_for_kind(kind: str) -> str:
    """Return what to do with a file that is not read under its name, by what kind_by_content() says of it."""
    return _REMEDIES.get(kind, _EXPORT)


def exif_of(image: Image.Image) -> Image.Exif:
    """Return the EXIF of an image without decoding its pixels if possible.

    To look for EXIF behind the pixels Pillow decodes a whole PNG, so this is done only if a chunk there may hold it.

    Raises:
        PILLOW_ERRORS: if it is damaged.
    """
    if image.format == "PNG":
        kinds = [kind for kind, *_ in png_chunks(Path(image.filename))]  # pyright: ignore[reportAttributeAccessIssue]
        behind = kinds[kinds.index(b"IDAT") :] if b"IDAT" in kinds else []
        if not {b"eXIf", b"tEXt", b"zTXt", b"iTXt"}.isdisjoint(behind):
            return image.getexif()
    return Image.Image.getexif(image)


def png_chunks(png: Path) -> Iterator[tuple[bytes, int, bytes]]:
    """Yield the kind of each chunk of a PNG, the length of its data, and the first 4 bytes of these."""
    with png.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            start = file.read(min(length, 4))
            yield kind, length, start
            file.seek(length - len(start) + 4, 1)


def require_file(path: Path) -> None:
    """Raise InputError if an image file is missing, empty, or not readable."""
    if not path.is_file():
        raise InputError(path, "image file not found", "check the data folder")
    try:
        with path.open("rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error})", "check its permissions") from None
    if empty:
        raise InputError(path, "image file is empty", DAMAGED)


def check_size(path: Path, width: int, height: int, most: int = MAX_PIXELS) -> None:
    """Raise InputError for a size of no pixels, of more than `most`, or with a side of more than MAX_SIDE."""
    if width < 1 or height < 1 or width * height > most:
        raise InputError(path, f"size {width} x {height} is not between 1 and {most} pixels", "scale the image down")
    if max(width, height) > MAX_SIDE:
        raise InputError(path, f"size {width} x {height} has a side of more than {MAX_SIDE}", "scale the image down")


def _decode(image: ImageFile.ImageFile, path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return code values [H, W, 3] and alpha [H, W] in [0, 1] or None."""
    if image.format == "HEIF" and image.info.get("bit_depth", 8) > 8:
        return _split(read_deep_heif(path))
    if has_planes_of_16_bits(image):
        return _split(read_planes(image, path))
    if _is_grey_alpha_of_16_bits(image):
        with open_image(path) as second:
            # Pillow keeps the high bytes. As RGBA of 8 bits the same samples give all bytes.
            second._mode = "RGBA"
            second.tile = [tile._replace(args="RGBA") for tile in second.tile]
            grey, alpha = np.moveaxis(np.asarray(second).view(">u2").astype(np.uint16), 2, 0)
        return _split(np.stack([grey, grey, grey, alpha], axis=2))
    if image.mode in ("RGB", "RGBA") and (tiles := _byte_tiles(image)):
        multiplied = "RGBa;" in str(image.tile)  # By alpha, which Pillow would divide by in 8 bits
        with open_image(path) as second:
            image.tile, second.tile = tiles
            values = np.asarray(image).astype(np.uint16) << 8 | np.asarray(second)
        if multiplied:
            light = values[..., :3] * (65535 / np.maximum(values[..., 3:], 1))
            values[..., :3] = np.rint(np.minimum(light, 65535))
        return _split(values)
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 65535:
            problem = f"signed or 32-bit values up to {int(values.max())} have no known white"
            raise InputError(path, problem, "export it with 16 bits")
        return _split(whole_range(image, values.astype(np.uint16)))
    transparent = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
    return _split(_convert(image, "RGBA" if transparent else "RGB"))


def _is_grey_alpha_of_16_bits(image: ImageFile.ImageFile) -> bool:
    return bool(image.tile) and image.tile[0].args == "LA;16B"


def _convert(image: Image.Image, mode: str) -> np.ndarray:
    """Convert an image to [H, W, C] uint8 in bands, because Pillow copies what it converts."""
    image.load()  # It may turn the image.
    width, height = image.size
    codes = np.empty((height, width, len(mode)), np.uint8)
    for top in range(0, height, _BAND_ROWS):
        band = image.crop((0, top, width, min(top + _BAND_ROWS, height)))
        codes[top : top + _BAND_ROWS] = np.asarray(band if band.mode == mode else band.convert(mode))
    return codes


def _split(values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    if values.ndim == 2:
        return np.repeat(values[:, :, None], 3, axis=2), None
    if values.shape[2] == 3:
        return values, None
    alpha, white = values[:, :, 3], np.iinfo(values.dtype).max
    return values[:, :, :3], None if alpha.min() == white else (alpha / np.float32(white)).astype(np.float32)


def _byte_tiles(image: ImageFile.ImageFile) -> tuple[list, list] | None:
    """Return tiles that decode the high and the low bytes of 16-bit color, as stored; None for other images.

    Pillow keeps the high byte; with the other byte order it keeps the low one.
    """
    other = {"16B": "16L", "16L": "16B", "16N": "16B" if np.little_endian else "16L"}
    high, low = [], []
    for tile in image.tile:
        raw, *rest = (tile.args,) if isinstance(tile.args, str) else tile.args or ("",)
        layout, _, depth = str(raw).partition(";")
        if layout not in ("RGB", "RGBA", "RGBX", "RGBa") or depth not in other:
            return None
        for tiles, order in ((high, depth), (low, other[depth])):
            mode = f"{layout.upper()};{order}"
            tiles.append(tile._replace(args=mode if isinstance(tile.args, str) else (mode, *rest)))
    return (high, low) if high else None


def turn_upright(array: np.ndarray, orientation: int) -> np.ndarray:
    """Turn [H, W, ...] as EXIF's orientation says: 5 to 8 swap the axes, then rows or columns are reversed."""
    array = array.swapaxes(0, 1) if orientation in (5, 6, 7, 8) else array
    array = array[::-1] if orientation in (3, 4, 7, 8) else array
    return np.ascontiguousarray(array[:, ::-1] if orientation in (2, 3, 6, 7) else array)


def orientation_of(image: Image.Image) -> int:
    """Return EXIF's orientation, 1 (as stored) if there is none."""
    try:
        return exif_of(image).get(0x0112, 1)
    except PILLOW_ERRORS:
        return 1


def turn_of_loaded(image: Image.Image, file_orientation: int, *, oriented: bool) -> int:
    """Return the turn, as of turn_upright(), of loaded pixels to upright ones if `oriented`, else to those in the file.

    `file_orientation` is orientation_of() a TIFF before Pillow loads it, which turns most TIFFs and removes the tag.
    """
    left = orientation_of(image)
    if oriented:
        return left
    return {6: 8, 8: 6}.get(file_orientation, file_orientation) if image.format == "TIFF" and left == 1 else 1


def png16(codes: np.ndarray, exif: bytes | None = None, level: int = -1) -> bytes:
    """Return a PNG file of [H, W, 3] uint16 codes.

    Args:
        codes: the pixels.
        exif: EXIF's TIFF structure, without the head that JPEG has before it; None for none.
        level: of zlib's compression, 0 to 9; -1 is its default.
    """
    height, width = codes.shape[:2]
    rows = codes.astype(">u2").reshape(height, -1).view(np.uint8)
    # Each row's filter, 2, is "Up": each byte less the one above it.
    filtered = np.insert(np.diff(rows, axis=0, prepend=np.uint8(0)), 0, 2, axis=1)
    chunks = {b"IHDR": struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)}
    chunks |= {} if exif is None else {b"eXIf": exif}
    chunks |= {b"IDAT": zlib.compress(filtered.tobytes(), level), b"IEND": b""}
    png = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks.items():
        png += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return png
