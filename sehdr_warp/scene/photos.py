"""Photos of any kind: encoded images, RAW files and float images, by their suffix."""

from pathlib import Path

from ..errors import InputError
from .hdr_files import hdr_size
from .images import EncodedImage, image_sizes, read_ldr, require_file
from .linear_photos import kind_of, raw_sizes, read_raw, tone_mapped

_ENCODED = {b"\xff\xd8\xff": ("JPEG", ".jpg"), b"\x89PNG\r\n": ("PNG", ".png")}


def photo_sizes(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return (width, height) of the photo as stored and turned upright; raises as read_photo."""
    kind = kind_of(path)
    if kind == "encoded":
        return image_sizes(path)
    _refuse_renamed(path)
    if kind == "raw":
        return raw_sizes(path)
    size = hdr_size(path)
    return size, size


def read_photo(path: Path, *, oriented: bool = False) -> EncodedImage:
    """Read the codes of a photo.

    RAW files have 16 bits in the sensor's primaries, float images 8 bits at an exposure of their own.

    Args:
        path: the file.
        oriented: turn the pixels upright.

    Raises:
        InputError: if the file is missing, damaged or too large.
    """
    kind = kind_of(path)
    if kind == "encoded":
        return read_ldr(path, oriented=oriented)
    return read_raw(path, oriented=oriented) if kind == "raw" else EncodedImage(tone_mapped(path), None)


def _refuse_renamed(path: Path) -> None:
    """Raise InputError for a photo of codes under the name of a RAW file or a float image."""
    require_file(path)
    with path.open("rb") as file:
        head = file.read(8)
    for signature, (kind, suffix) in _ENCODED.items():
        if head.startswith(signature):
            raise InputError(path, f"is a {kind} photo, not what its name says", f"name it {suffix}")
