"""Photos of any kind: encoded ones, RAW files and float pictures, by their suffix."""

from pathlib import Path

from .hdr_files import hdr_size
from .images import EncodedImage, image_sizes, read_ldr
from .linear_photos import kind_of, raw_sizes, read_raw, tone_mapped


def photo_sizes(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """(width, height) of the photo in its file and turned upright; InputError as read_photo raises it."""
    kind = kind_of(path)
    if kind == "encoded":
        return image_sizes(path)
    if kind == "raw":
        return raw_sizes(path)
    size = hdr_size(path)
    return size, size


def read_photo(path: Path, *, oriented: bool = False) -> EncodedImage:
    """The codes of a photo; of RAW files 16 bits of the sensor's colors, of float pictures 8 at their own exposure.

    oriented: turn the pixels upright. Raises InputError where the file is missing, damaged or too large.
    """
    kind = kind_of(path)
    if kind == "encoded":
        return read_ldr(path, oriented=oriented)
    return read_raw(path, oriented=oriented) if kind == "raw" else EncodedImage(tone_mapped(path), None)
