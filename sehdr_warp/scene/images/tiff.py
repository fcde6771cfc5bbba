"""TIFF as cameras and converters write it, where Pillow does not read all bits or does not say what is wrong."""

import io
import struct
from pathlib import Path

import numpy as np
from PIL import Image, ImageFile, TiffImagePlugin, UnidentifiedImageError

BIG_ENDIAN = "a BigTIFF whose bytes are in big-endian order"
_MOST_PAGES = 16  # That are looked at
_MOST_BYTES = (1 << 32) - (1 << 20)  # Places in a TIFF have 32 bits; less what a directory needs
_HEADS = {"<": b"II*\0", ">": b"MM\0*"}
_BIG_HEADS = {"<": b"II+\0", ">": b"MM\0+"}
_FLOAT = 3  # SampleFormat


def describe_tiff(path: Path) -> str | None:
    """Return in words what a TIFF is that Pillow does not read; None for other files.

    Raises:
        PILLOW_ERRORS: if it is damaged.
    """
    with path.open("rb") as file:
        head = file.read(16)
        if head[:4] == _BIG_HEADS[">"]:
            return BIG_ENDIAN
        if head[:4] not in (*_HEADS.values(), *_BIG_HEADS.values()):
            return None
        tags = TiffImagePlugin.ImageFileDirectory_v2(head if head[:4] in _BIG_HEADS.values() else head[:8])
        file.seek(tags.next)
        tags.load(file)
    if _FLOAT in tags.get(339, ()):
        return "a TIFF of floats"
    bits = tags.get(258, (1,))
    return f"a TIFF of {tags.get(277, 1)} channels of {bits[0]} bits (compression {tags.get(259, 1)})"


def whole_range(image: Image.Image, values: np.ndarray) -> np.ndarray:
    """Return 16-bit codes that rise with light from 0 to 65535, from grey samples as Pillow reads them."""
    if image.format != "TIFF":
        return values
    tags = image.tag_v2  # pyright: ignore[reportAttributeAccessIssue]
    bits = tags.get(258, (16,))[0]
    if bits < 16:
        values = np.rint(values * (65535 / (2**bits - 1))).astype(np.uint16)
    return 65535 - values if tags.get(262) == 0 else values  # WhiteIsZero


def has_thumbnails(image: ImageFile.ImageFile) -> bool:
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


def has_planes_of_16_bits(image: ImageFile.ImageFile) -> bool:
    """Return whether an image is a TIFF with a plane of 16 bits for each channel, of which Pillow reads 8 bits."""
    if image.format != "TIFF":
        return False
    tags = image.tag_v2  # pyright: ignore[reportAttributeAccessIssue]
    return tags.get(284) == 2 and len(tags.get(258, ())) > 1 and set(tags[258]) == {16}


def read_planes(image: ImageFile.ImageFile, path: Path) -> np.ndarray:
    """Return [H, W, 3 or 4] uint16 of a TIFF with a plane for each channel: each is read as a picture of its own.

    Raises PILLOW_ERRORS if it is damaged.
    """
    tags, planes = image.tag_v2, []  # pyright: ignore[reportAttributeAccessIssue]
    data = path.read_bytes()
    order = "<" if data[:2] == b"II" else ">"
    if len(data) > _MOST_BYTES:
        raise ValueError("a BigTIFF of more than 4 GB with a plane for each channel")
    for plane in range(len(image.mode)):
        fields = {tag: (tags[tag],) for tag in (256, 257, 259, 278, 317, 322, 323) if tag in tags}
        fields |= {258: (16,), 262: (1,), 277: (1,)}  # Bits, grey, one sample
        for tag in (273, 279, 324, 325):  # Places and lengths of strips or tiles
            if tag in tags:
                count = len(tags[tag]) // tags[277]
                fields[tag] = tags[tag][plane * count : (plane + 1) * count]
        single = _HEADS[order] + struct.pack(f"{order}I", len(data)) + data[8:] + _directory(fields, len(data), order)
        try:
            with Image.open(io.BytesIO(single), formats=("TIFF",)) as one:
                planes.append(np.asarray(one).astype(np.uint16))
        except UnidentifiedImageError:  # Its message names an object of Python.
            raise ValueError(f"the strips of channel {plane + 1} are damaged") from None
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
