"""Readers of LDR images: PNG (8 and 16 bits), JPEG, TIFF, WebP and BMP, with sizes checked before decoding.

All images are opened by open_image. The content decides the format, whatever the name says, and only these formats are
decoded: Pillow knows many more, and passes some (EPS) to other programs.
"""

import io
import re
import struct
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageFile, TiffImagePlugin

from ..errors import InputError
from .heif import HEIF_SUFFIXES, heif_installed, is_heif, read_deep_heif, register_heif

MAX_PIXELS = 160_000_000
"""Above the frame of any camera (the largest backs have 151 megapixels), far below what would exhaust memory."""
MAX_SIDE = 65_536  # No photo has a longer side; a damaged one with few pixels in all would take long to decode
LDR_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".avif", *HEIF_SUFFIXES * heif_installed())
"""HEIF's among them if the package that decodes it is installed."""
HDR_SUFFIXES = (".exr", ".hdr")
RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw")
PHOTO_SUFFIXES = (*LDR_SUFFIXES, *RAW_SUFFIXES, *HDR_SUFFIXES)
_BAND_ROWS = 512
_MOST_PAGES = 16  # Of a TIFF that are looked at
_opening = threading.Lock()  # Pillow's pixel limit, which is lifted while opening, is shared by all threads
_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "AVIF")
_MODES = ("L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "I", "I;16", "I;16L", "I;16B", "I;16N")
_OTHER_MODES = {
    "1": "one bit a pixel, black or white",
    "CMYK": "inks (CMYK), not light",
    "LAB": "CIELAB, not RGB",
    "F": "floating-point values, not encoded ones",
}
DAMAGED = "copy or export the image again"
_EXPORT = "export it as RGB or grey, in PNG or JPEG"
_TIFF_HEADS = (b"II*\0", b"MM\0*")
_SIGNATURES = {
    b"\xff\x0a": "JPEG XL", b"\0\0\0\x0cJXL ": "JPEG XL", b"\0\0\0\x0cjP  ": "JPEG 2000", b"GIF8": "a GIF",
    b"8BPS": "a Photoshop file", b"v/1\x01": "OpenEXR", b"#?R": "a Radiance picture", b"%PDF": "a PDF",
    b"<!DOCTYPE": "a web page", b"<html": "a web page", b"version https://git-lfs": "a Git LFS pointer",
}  # fmt: skip
_REMEDIES = {
    "OpenEXR": "name it .exr", "a Radiance picture": "name it .hdr",
    "a Git LFS pointer": "fetch it with `git lfs pull`", "a web page": "download the photo again",
    "a TIFF of floats": "export it with 16 bits, or as OpenEXR",
}  # fmt: skip
"""Remedies for files of other kinds, where exporting them is not the remedy."""
PILLOW_ERRORS = (
    ArithmeticError, AttributeError, EOFError, Image.DecompressionBombError, LookupError, MemoryError, OSError,
    RuntimeError, SyntaxError, TypeError, ValueError, struct.error,
)  # fmt: skip
"""Exceptions that Pillow raises for damaged files. If it does so for EXIF, the pixels may still be good."""


@dataclass(frozen=True)
class EncodedImage:
    """The codes of a photo, and what its file states beside them.

    Attributes:
        pixels: [H, W, 3] uint8 or uint16, the stored codes.
        alpha: [H, W] float32 in [0, 1]; None if all is opaque.
        above_white: [H, W, 3] float16, light of white pixels as a multiple of white's; 0 where it is not known. None if
            the file states none.
        above_white_deviation: standard deviation of the natural logarithm of above_white.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None
    above_white: np.ndarray | None = None
    above_white_deviation: float = 0.0

    @property
    def levels(self) -> int:
        """The largest code: 255 or 65535."""
        return int(np.iinfo(self.pixels.dtype).max)


def image_sizes(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the photo's size as stored and after its EXIF orientation, each (width, height); raises as open_image."""
    with open_image(path) as image:
        width, height = image.size
        return image.size, (height, width) if orientation_of(image) in (5, 6, 7, 8) else image.size


def read_ldr(path: Path, *, oriented: bool = False, mask: bool = False) -> EncodedImage:
    """Decode a photo; 16-bit files keep their 16 bits, palettes and grey become RGB.

    Args:
        path: the file.
        oriented: turn the pixels as the EXIF orientation says.
        mask: accept one bit per pixel.

    Raises:
        InputError: if the file is missing, damaged, truncated, of another kind, or larger than MAX_PIXELS.
    """
    with open_image(path, mask=mask) as image:
        try:
            pixels, alpha = _decode(image, path)
            turn = orientation_of(image) if oriented else 1
        except PILLOW_ERRORS as error:
            raise InputError(path, f"cannot be decoded ({error})", DAMAGED) from None
    return EncodedImage(turn_upright(pixels, turn), None if alpha is None else turn_upright(alpha, turn))


def has_16_bits(path: Path) -> bool:
    """Return whether a photo that read_ldr decodes has 16 bits; raises as open_image."""
    with open_image(path) as image:
        return image.mode.startswith("I") or bool(_low_byte_tiles(image)) or _has_planes_of_16_bits(image, path)


def open_image(path: Path, *, mask: bool = False) -> ImageFile.ImageFile:
    """Open an image and read its header, not its pixels.

    Of a stereo pair or a photo with a gain map (MPO) it is the first image.

    Args:
        path: the file.
        mask: accept one bit per pixel.

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
            several = getattr(image, "is_animated", False) and image.format != "MPO" and not _has_thumbnails(image)
        except PILLOW_ERRORS as error:
            if kind := _kind_by_content(path):
                raise InputError(
                    path, f"is {kind}, which is not read as a photo", _REMEDIES.get(kind, _EXPORT)
                ) from None
            kinds = f", which is one of {', '.join(_FORMATS)}" * (not heif)
            detail = kinds if "cannot identify" in str(error) else f" ({error})"
            raise InputError(path, f"is not a readable {'HEIC photo' if heif else 'image'}{detail}", DAMAGED) from None
        finally:
            Image.MAX_IMAGE_PIXELS = limit
    try:
        check_size(path, *image.size)
        if several:
            raise InputError(path, "holds several pictures, pages or an animation", "save the one that counts")
        if image.mode not in (*_MODES, *("1" * mask)):
            mode = _OTHER_MODES.get(image.mode, f"{image.mode}, not RGB")
            raise InputError(path, f"holds {mode}", _EXPORT)
    except InputError:
        image.close()
        raise
    return image


def _has_thumbnails(image: ImageFile.ImageFile) -> bool:
    """Return whether all pictures of a TIFF behind the first are smaller copies of it, or masks (NewSubfileType)."""
    if image.format != "TIFF":
        return False
    count = min(image.n_frames, _MOST_PAGES + 1)  # pyright: ignore[reportAttributeAccessIssue]
    for page in range(1, count):
        image.seek(page)
        if not image.tag_v2.get(254, 0) & 5:  # pyright: ignore[reportAttributeAccessIssue]
            return False
    image.seek(0)
    return count <= _MOST_PAGES


def _kind_by_content(path: Path) -> str | None:
    """Return in words what a file is that Pillow does not read, None if it is not known."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    for signature, kind in _SIGNATURES.items():
        if head.startswith(signature):
            return kind
    if head[:2] == b"\xff\xd8" and re.search(rb"\xff[\xc0-\xc2]\0.\x0c", head, re.DOTALL):
        return "a JPEG of 12 bits"
    if head[:4] in _TIFF_HEADS:
        with suppress(*PILLOW_ERRORS):
            tags = TiffImagePlugin.ImageFileDirectory_v2(head[:8])
            with path.open("rb") as file:
                file.seek(tags.next)
                tags.load(file)
            return "a TIFF of floats" if 3 in tags.get(339, ()) else None
    return None


def exif_of(image: Image.Image) -> Image.Exif:
    """Return the EXIF of an image without decoding its pixels if possible.

    To look for EXIF behind the pixels Pillow decodes a whole PNG, so this is done only if a chunk there may hold it.

    Raises:
        PILLOW_ERRORS: if it is damaged.
    """
    if image.format == "PNG" and _has_text_behind_pixels(Path(image.filename)):  # pyright: ignore[reportAttributeAccessIssue]
        return image.getexif()
    return Image.Image.getexif(image)


def _has_text_behind_pixels(png: Path) -> bool:
    """Return whether a PNG has a chunk that may hold EXIF behind its pixels."""
    with png.open("rb") as file:
        file.seek(8)
        behind = False
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            behind |= kind == b"IDAT"
            if behind and kind in (b"eXIf", b"tEXt", b"zTXt", b"iTXt"):
                return True
            file.seek(length + 4, 1)
    return False


def require_file(path: Path) -> None:
    """Raise InputError if an image file is missing or empty."""
    if not path.is_file():
        raise InputError(path, "image file not found", "check the data folder")
    if path.stat().st_size == 0:
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
    if _has_planes_of_16_bits(image, path):
        return _split(_planes(image, path))
    if image.mode in ("RGB", "RGBA") and (low := _low_byte_tiles(image)):
        with open_image(path) as second:
            second.tile = low
            low_bytes = np.asarray(second)
        return _split(np.asarray(image).astype(np.uint16) << 8 | low_bytes)
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 65535:
            problem = f"32-bit values up to {int(values.max())} have no known white"
            raise InputError(path, problem, "export it with 16 bits")
        return _split(values.astype(np.uint16))
    transparent = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
    return _split(_converted(image, "RGBA" if transparent else "RGB"))


def _converted(image: Image.Image, mode: str) -> np.ndarray:
    """Convert an image to [H, W, C] uint8 in bands, because Pillow copies what it converts."""
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


def _low_byte_tiles(image: ImageFile.ImageFile) -> list | None:
    """Return tiles that decode the low bytes of 16-bit color.

    Pillow keeps the high byte; with the other byte order it keeps the low one.
    """
    other = {"16B": "16L", "16L": "16B", "16N": "16B" if np.little_endian else "16L"}
    tiles = []
    for tile in image.tile:
        raw, *rest = (tile.args,) if isinstance(tile.args, str) else tile.args or ("",)
        layout, _, depth = str(raw).partition(";")
        if layout not in ("RGB", "RGBA", "RGBX") or depth not in other:
            return None
        mode = f"{layout};{other[depth]}"
        tiles.append(tile._replace(args=mode if isinstance(tile.args, str) else (mode, *rest)))
    return tiles or None


def _has_planes_of_16_bits(image: ImageFile.ImageFile, path: Path) -> bool:
    """Return whether an image is a TIFF with a plane of 16 bits for each channel, of which Pillow reads 8 bits."""
    if image.format != "TIFF":
        return False
    tags = image.tag_v2  # pyright: ignore[reportAttributeAccessIssue]
    with path.open("rb") as file:
        small = file.read(4) in _TIFF_HEADS  # Else BigTIFF, whose directories are others
    return small and tags.get(284) == 2 and len(tags.get(258, ())) > 1 and set(tags[258]) == {16}


def _planes(image: ImageFile.ImageFile, path: Path) -> np.ndarray:
    """Return [H, W, 3 or 4] uint16 of a TIFF with a plane for each channel: each is read as a picture of its own.

    Raises PILLOW_ERRORS if it is damaged.
    """
    tags, planes = image.tag_v2, []  # pyright: ignore[reportAttributeAccessIssue]
    data = path.read_bytes()
    order = "<" if data[:2] == b"II" else ">"
    for plane in range(len(image.mode)):
        fields = {tag: (tags[tag],) for tag in (256, 257, 259, 278, 317, 322, 323) if tag in tags}
        fields |= {258: (16,), 262: (1,), 277: (1,)}  # Bits, grey, one sample
        for tag in (273, 279, 324, 325):  # Places and lengths of strips or tiles
            if tag in tags:
                count = len(tags[tag]) // tags[277]
                fields[tag] = tags[tag][plane * count : (plane + 1) * count]
        single = data[:4] + struct.pack(f"{order}I", len(data)) + data[8:] + _directory(fields, len(data), order)
        with Image.open(io.BytesIO(single), formats=("TIFF",)) as one:
            planes.append(np.asarray(one).astype(np.uint16))
    return np.stack(planes, axis=2)


def _directory(fields: dict[int, tuple[int, ...]], place: int, order: str) -> bytes:
    """Return a TIFF directory (TIFF 6.0, section 2) of whole numbers that lies at a place in its file."""
    behind = place + 2 + 12 * len(fields) + 4
    entries, values = struct.pack(f"{order}H", len(fields)), b""
    for tag, numbers in sorted(fields.items()):
        short = tag in (258, 259, 262, 277, 317)
        packed = struct.pack(f"{order}{len(numbers)}{'H' if short else 'I'}", *numbers).ljust(4, b"\0")
        entries += struct.pack(f"{order}HHI", tag, 3 if short else 4, len(numbers))
        entries += packed if len(packed) == 4 else struct.pack(f"{order}I", behind + len(values))
        values += packed if len(packed) > 4 else b""
    return entries + bytes(4) + values


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
