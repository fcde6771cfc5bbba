"""The boxes of HEIF and AVIF files (ISO/IEC 14496-12 and 23008-12): which pictures they hold, and what belongs to them.

pillow-heif and Pillow decode pictures. Neither reads a gain map that is a derived item (`tmap`), of metadata of
another picture than the primary one, or, for AVIF, of the stated transfer function.
"""

import importlib.util
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ...errors import InputError, require_extra

HEIF_SUFFIXES = (".heic", ".heif", ".hif")
_DAMAGED = "copy or export the photo again"
_MOST_ITEMS = 100_000
_LARGEST_ITEM = 1 << 28
_HEAD_BYTES = 1 << 24  # Of a meta box
_HEIF_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"mif1", b"mif2", b"hevc", b"hevx", b"msf1"}


@dataclass(frozen=True)
class Item:
    """A picture, a derived picture or metadata in a HEIF file."""

    kind: str  # As hvc1, av01, grid, tmap, Exif or mime
    extents: tuple[tuple[int, int], ...] = ()  # (offset in the file, length) of parts; length 0: to the end
    inside: bytes | None = None  # The bytes themselves, if they lie in the meta box; None otherwise
    properties: tuple[tuple[str, bytes], ...] = ()  # (type, payload) of each property, for example `colr`
    flags_place: int = 0  # Where in the file the byte of flags lies, whose lowest bit hides the item from viewers


@dataclass(frozen=True)
class HeifItems:
    """Items of a file's meta box."""

    primary: int  # Number of the picture that a viewer shows
    items: dict[int, Item]  # By number
    references: tuple[tuple[str, int, tuple[int, ...]], ...]  # (kind, from, to): ("dimg", tmap, (base, gain map))
    primary_place: tuple[int, int]  # Where in the file the number of the primary item lies, and its bytes (2 or 4)


@cache
def heif_installed() -> bool:
    """Return whether pillow-heif, which decodes HEIF, is installed."""
    return importlib.util.find_spec("pillow_heif") is not None


def is_heif(path: Path) -> bool:
    """Return whether a file says in its first bytes that it is HEIF; AVIF is not meant."""
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError:
        return False
    if head[4:8] != b"ftyp":
        return False
    brands = {head[8:12], *(head[i : i + 4] for i in range(16, min(len(head), int.from_bytes(head[:4])), 4))}
    return bool(brands & _HEIF_BRANDS) and not brands & {b"avif", b"avis"}


def register_heif(path: Path) -> None:
    """Make Pillow able to open HEIF. Raises SehdrError if pillow-heif is not installed."""
    pillow_heif = require_extra("pillow_heif", f"{path}: HEIC photos need pillow-heif", "phone")
    pillow_heif.register_heif_opener(thumbnails=False, depth_images=False)


def read_deep_heif(path: Path) -> np.ndarray:
    """Return [H, W, 3 or 4] uint16 of a HEIF photo of 10 or 12 bits, turned upright."""
    import pillow_heif

    image = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
    pixels, bits = np.asarray(image), np.uint16(image.info["bit_depth"])
    # pillow-heif moves codes to the top of 16 bits; the low bits are filled, so that white is 65535.
    return pixels | pixels >> bits


def read_items(path: Path) -> HeifItems:
    """Return the items of a HEIF or AVIF file. Raises InputError if its boxes are damaged."""
    try:
        with path.open("rb") as file:
            data = file.read(_HEAD_BYTES)
        _, start, end = next(box for box in _boxes(data, 0, len(data)) if box[0] == "meta")
        return _items(data, start + 4, end)
    except StopIteration:
        raise InputError(path, "has no list of pictures (meta box)", _DAMAGED) from None
    except (struct.error, ValueError, IndexError, KeyError, OverflowError) as error:
        raise InputError(path, f"its list of pictures is damaged ({error!s:.80})", _DAMAGED) from None


def avif_bits(path: Path) -> int:
    """Return the bits of an AVIF photo's samples: 8, 10 or 12; 8 for other files, or if it does not state them."""
    with path.open("rb") as file:
        if b"avif" not in file.read(64)[4:]:
            return 8
    try:
        items = read_items(path)
        data = next(data for kind, data in items.items[items.primary].properties if kind == "av1C")
        return 12 if data[2] & 0x20 else 10 if data[2] & 0x40 else 8
    except (InputError, KeyError, IndexError, StopIteration):
        return 8


def item_bytes(path: Path, item: Item) -> bytes:
    """Return the bytes of an item. Raises InputError if they reach beyond the file, or are more than it holds."""
    if item.inside is not None:
        return item.inside
    size, parts, total = path.stat().st_size, [], 0
    with path.open("rb") as file:
        for offset, length in item.extents:
            length = length or size - offset
            total += length
            if not 0 <= offset <= offset + length <= size:
                raise InputError(path, f"an item reaches to byte {offset + length} of {size}", _DAMAGED)
            if total > min(size, _LARGEST_ITEM):
                raise InputError(path, f"the parts of an item have {total} bytes or more", _DAMAGED)
            file.seek(offset)
            parts.append(file.read(length))
    return b"".join(parts)


def with_primary(path: Path, items: HeifItems, number: int) -> bytes:
    """Return the file's bytes with another of its pictures as the primary one, so that any decoder shows it."""
    data = bytearray(path.read_bytes())
    place, size = items.primary_place
    data[place : place + size] = number.to_bytes(size)
    data[items.items[number].flags_place] &= 0xFE
    return bytes(data)


def _boxes(data: bytes, start: int, end: int) -> Iterator[tuple[str, int, int]]:
    """Yield type, first byte of the payload and end of each box in a range. Raises ValueError for impossible sizes."""
    while start + 8 <= end:
        size, kind = struct.unpack_from(">I4s", data, start)
        head = 8
        if size == 1:
            (size,), head = struct.unpack_from(">Q", data, start + 8), 16
        size = size or end - start
        if size < head:
            raise ValueError(f"a box of {size} bytes")
        yield kind.decode("latin-1"), start + head, min(start + size, end)
        start += size


def _items(data: bytes, start: int, end: int) -> HeifItems:
    boxes = {kind: (first, last) for kind, first, last in _boxes(data, start, end)}
    place = boxes["pitm"][0]
    size = 4 if data[place] else 2
    primary_place = place + 4, size
    primary = int.from_bytes(data[place + 4 : place + 4 + size])
    kinds = _kinds(data, *boxes["iinf"])
    places = _places(data, *boxes["iloc"]) if "iloc" in boxes else {}
    inner = boxes.get("idat")
    properties = _properties(data, *boxes["iprp"]) if "iprp" in boxes else {}
    items, total = {}, 0
    for number, (kind, flags_place) in kinds.items():
        method, extents = places.get(number, (0, ()))
        inside = None
        if method == 1 and inner is not None:
            total += sum(length for _, length in extents)
            if total > len(data):  # Parts may overlap, and be many.
                raise ValueError(f"{total} bytes of items in {len(data)} bytes")
            inside = b"".join(data[inner[0] + at : inner[0] + at + length] for at, length in extents)
        items[number] = Item(kind, extents, inside, properties.get(number, ()), flags_place)
    references = tuple(_references(data, *boxes["iref"])) if "iref" in boxes else ()
    return HeifItems(primary, items, references, primary_place)


def _kinds(data: bytes, start: int, end: int) -> dict[int, tuple[str, int]]:
    """Return the kind of each item of an `iinf` box, and where the byte of its flags lies."""
    first = start + (6 if data[start] == 0 else 8)
    kinds = {}
    for kind, at, _ in _boxes(data, first, end):
        version = data[at]
        if kind == "infe" and version >= 2 and len(kinds) < _MOST_ITEMS:
            layout = ">HH4s" if version == 2 else ">IH4s"
            number, _, item_kind = struct.unpack_from(layout, data, at + 4)
            kinds[number] = item_kind.decode("latin-1"), at + 3
    return kinds


def _places(data: bytes, start: int, end: int) -> dict[int, tuple[int, tuple[tuple[int, int], ...]]]:
    """Return construction method and extents of each item of an `iloc` box."""
    version = data[start]
    sizes = data[start + 4] >> 4, data[start + 4] & 15, data[start + 5] >> 4, data[start + 5] & 15
    at = start + 6

    def take(size: int) -> int:
        nonlocal at
        if at + size > end:
            raise ValueError("iloc ends early")
        at += size
        return int.from_bytes(data[at - size : at])

    offset_size, length_size, base_size, index_size = sizes
    places, total = {}, 0
    for _ in range(take(4 if version == 2 else 2)):
        number = take(4 if version == 2 else 2)
        method = take(2) & 15 if version else 0
        take(2)  # Number of a data reference; 0 is this file.
        base = take(base_size)
        extents = []
        count = take(2)
        total += count
        if total > _MOST_ITEMS:
            raise ValueError(f"{total} parts of items")
        for _ in range(count):
            if version:
                take(index_size)
            offset = base + take(offset_size)
            extents.append((offset, take(length_size)))
        places[number] = method, tuple(extents)
    return places


def _properties(data: bytes, start: int, end: int) -> dict[int, tuple[tuple[str, bytes], ...]]:
    """Return the properties of each item of an `iprp` box."""
    every: list[tuple[str, bytes]] = []
    properties: dict[int, tuple[tuple[str, bytes], ...]] = {}
    for kind, at, last in _boxes(data, start, end):
        if kind == "ipco":
            every = [(name, data[first:final]) for name, first, final in _boxes(data, at, last)]
        if kind == "ipma":
            wide_item, wide_index = data[at] > 0, data[at + 3] & 1
            (count,) = struct.unpack_from(">I", data, at + 4)
            at += 8
            for _ in range(min(count, _MOST_ITEMS)):
                number = int.from_bytes(data[at : at + (4 if wide_item else 2)])
                at += 4 if wide_item else 2
                size, length = 2 if wide_index else 1, data[at]
                indices = [int.from_bytes(data[at + 1 + i * size : at + 1 + (i + 1) * size]) for i in range(length)]
                at += 1 + length * size
                indices = [index & (0x7FFF if wide_index else 0x7F) for index in indices]
                properties[number] = tuple(every[index - 1] for index in indices if 0 < index <= len(every))
    return properties


def _references(data: bytes, start: int, end: int) -> Iterator[tuple[str, int, tuple[int, ...]]]:
    """Yield the references of an `iref` box."""
    letter = "H" if data[start] == 0 else "I"
    for kind, at, _ in _boxes(data, start + 4, end):
        number, count = struct.unpack_from(f">{letter}H", data, at)
        first = at + struct.calcsize(f">{letter}H")
        yield kind, number, struct.unpack_from(f">{count}{letter}", data, first)
