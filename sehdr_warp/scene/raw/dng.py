"""Read what a DNG file states of its raw image: levels, geometry, opcode lists (Adobe's DNG specification 1.7).

LibRaw decodes the samples. It applies LinearizationTable, and leaves the rest of this file's tags to others or to one
level for all channels.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import TiffImagePlugin

from ...errors import InputError
from ..images.ldr_files import DAMAGED, PILLOW_ERRORS

# Tags of TIFF and DNG, by the names of their specifications.
_NEW_SUBFILE_TYPE, _WIDTH, _LENGTH, _BITS, _COMPRESSION, _PHOTOMETRIC = 254, 256, 257, 258, 259, 262
_ORIENTATION, _SAMPLES, _SUB_IFDS, _SAMPLE_FORMAT, _DNG_VERSION = 274, 277, 330, 339, 50706
_CFA_REPEAT, _CFA_PATTERN, _CFA_LAYOUT = 33421, 33422, 50711
_BLACK_REPEAT, _BLACK, _BLACK_DELTA_H, _BLACK_DELTA_V, _WHITE = 50713, 50714, 50715, 50716, 50717
_DEFAULT_SCALE, _CROP_ORIGIN, _CROP_SIZE, _ACTIVE_AREA = 50718, 50719, 50720, 50829
_OPCODE_LISTS = 51008, 51009, 51022
_CFA, _LINEAR_RAW = 32803, 34892
_TILE_WIDTH, _TILE_LENGTH, _ROWS_PER_STRIP, _LINEARIZATION = 322, 323, 278, 50712
_PLACES, _LENGTHS = (324, 273), (325, 279)  # Of tiles, or strips
_UNCOMPRESSED, _LOSSLESS_JPEG, _LOSSY_JPEG, _JPEG_XL = 1, 7, 34892, 52546
# Compressions of integers that LibRaw does not decode.
_UNDECODED = {5: "LZW", 8: "Deflate", 9: "VC-5 (GoPro GPR)", 32773: "PackBits", 32946: "Deflate", _JPEG_XL: "JPEG XL"}
_MOST_IFDS = 64
_LARGEST_SCALE = 8.0  # Of DefaultScale; files state 1 or 2
_FLOAT = 3  # SampleFormat
_MOST_JPEG = 1 << 20  # Bytes of a JPEG picture beside six for each of its pixels
_BIG_HEADS = b"II+\0", b"MM\0+"
_CONVERT = "convert it with Adobe DNG Converter"
_MAX_SIDE = 65536  # Pixels of the longest side that is read, because a damaged size would fill the memory
_MAX_REPEAT = 64  # Rows and columns of the largest pattern of black levels that is read


@dataclass(frozen=True)
class JpegTiles:
    """Baseline JPEG pictures that a lossy DNG's linear raw image consists of, row by row."""

    size: tuple[int, int]  # (width, height) of each; the last ones may reach beyond the image, or end with it
    places: tuple[tuple[int, int], ...]  # (offset in the file, length) of each
    linearization: np.ndarray | None  # Stored value of each code; None if codes are stored values


@dataclass(frozen=True)
class DngRaw:
    """The tags of a DNG's raw image that decide what its samples mean."""

    size: tuple[int, int]  # (width, height) of the stored image
    pattern: np.ndarray | None  # [n, n] channels of the filter from the active area's top left; None for linear raw
    active: tuple[int, int, int, int]  # Top, left, bottom, right of the picture, pixels of the stored image
    black: np.ndarray  # [rows, columns, samples] float64, repeated over the active area from its top left
    black_columns: np.ndarray  # [width of the active area] added to the black level; likewise black_rows
    black_rows: np.ndarray
    white: np.ndarray  # [samples] float64
    scale: tuple[float, float]  # (horizontal, vertical): factors to square pixels
    crop: tuple[float, float, float, float]  # Left, top, width, height inside the active area, pixels before scale
    orientation: int  # EXIF's, 1 to 8
    opcodes: tuple[bytes, bytes, bytes]  # Lists 1 (stored samples), 2 (light) and 3 (demosaiced light), as bytes
    tiles: JpegTiles | None = None  # Of a lossy DNG, which LibRaw decodes by a curve of its own; None otherwise

    @property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return (width, height) of the developed photo as the sensor lies, and turned upright."""
        width, height = (max(1, round(side * scale)) for side, scale in zip(self.crop[2:], self.scale, strict=True))
        return (width, height), (height, width) if self.orientation in (5, 6, 7, 8) else (width, height)


def read_dng(path: Path) -> DngRaw | None:
    """Return what a DNG states of its raw image, or None if the file is a RAW file of another kind.

    Raises:
        InputError: if the file is a DNG whose tags are damaged, or holds samples that LibRaw does not decode.
    """
    try:
        with path.open("rb") as file:
            big = file.read(4) in _BIG_HEADS
            file.seek(0)
            tables = list(_tables(file))
    except (*PILLOW_ERRORS, IndexError):
        return None  # LibRaw's message says what is wrong.
    if not tables or _DNG_VERSION not in tables[0]:
        return None
    if big:
        raise InputError(path, "is a DNG in the form of a BigTIFF, which LibRaw does not read", _CONVERT)
    # Directories of another subfile type hold a preview, a mask or a depth map.
    raw = [
        table
        for table in tables
        if table.get(_PHOTOMETRIC) in (_CFA, _LINEAR_RAW) and not table.get(_NEW_SUBFILE_TYPE, 0)
    ]
    if not raw:
        return None
    try:
        table = max(raw, key=lambda entry: int(entry.get(_WIDTH, 0)) * int(entry.get(_LENGTH, 0)))
        _check_decodable(path, table)
        return _raw_of(table, tables[0])
    except (LookupError, TypeError, ValueError, ArithmeticError, OverflowError) as error:
        raise InputError(path, f"its DNG tags cannot be used: {error!s:.90}", DAMAGED) from None


def _tables(file: Any) -> Iterator[Any]:
    """Yield the image file directories of a TIFF file, those of SubIFDs included."""
    prefix = file.read(8)
    if prefix[:4] in _BIG_HEADS:
        prefix += file.read(8)  # BigTIFF
    head = TiffImagePlugin.ImageFileDirectory_v2(prefix)
    places, visited = [head.next], set()
    while places and len(visited) < _MOST_IFDS:
        place = places.pop(0)
        if not place or place in visited:
            continue
        visited.add(place)
        table = TiffImagePlugin.ImageFileDirectory_v2(prefix)
        file.seek(place)
        table.load(file)
        inner = table.get(_SUB_IFDS, ())
        places += [*(inner if isinstance(inner, tuple) else (inner,)), table.next]
        yield table


def _check_decodable(path: Path, table: Any) -> None:
    """Raise InputError for samples that LibRaw does not decode, or not by one scale for all photos."""
    compression, is_float = table.get(_COMPRESSION, _UNCOMPRESSED), _FLOAT in _numbers(table, _SAMPLE_FORMAT, (1,))
    other = compression not in (0, _UNCOMPRESSED, _LOSSLESS_JPEG, _LOSSY_JPEG)
    if other and (not is_float or compression == _JPEG_XL):
        remedy = f"{_CONVERT} (lossless JPEG)"
        remedy += ", or choose JPEG Lossless in the phone's RAW settings" * (compression == _JPEG_XL)
        name = _UNDECODED.get(compression, f"compression {compression}")
        raise InputError(path, f"is a DNG compressed as {name}, which LibRaw does not decode", remedy)
    if compression == _LOSSY_JPEG and table.get(_PHOTOMETRIC) != _LINEAR_RAW:
        raise InputError(path, "is a DNG whose color filter's samples are compressed with loss", _CONVERT)
    if is_float:
        problem = "is a DNG of floating-point samples (an HDR merge), which LibRaw scales differently in each file"
        raise InputError(path, problem, "export it as OpenEXR, or use the photos that it was merged from")
    if _samples(table) == 1 and table.get(_PHOTOMETRIC) == _LINEAR_RAW:
        problem = "is a DNG of one channel (a monochrome sensor), without color"
        raise InputError(path, problem, "use photos of a camera with colors, or develop them as grey TIFF")
    if _samples(table) not in (1, 3):
        problem = f"is a DNG of {_samples(table)} samples a pixel, not 1 or 3"
        raise InputError(path, problem, "develop the photos as JPEG, PNG or TIFF")


def _pattern(table: Any) -> np.ndarray:
    """Return the color filter's channels. Raises ValueError for one that is not a grid of red, green and blue."""
    rows, columns = (int(v) for v in _numbers(table, _CFA_REPEAT, ()))
    pattern = np.array(_numbers(table, _CFA_PATTERN, ()), int).reshape(rows, columns)
    if rows != columns or set(pattern.ravel().tolist()) != {0, 1, 2} or _numbers(table, _CFA_LAYOUT, (1,)) != (1,):
        raise ValueError(f"a color filter of {rows} x {columns}, {pattern.tolist()!s:.40}")
    return pattern


def _samples(table: Any) -> int:
    return int(_numbers(table, _SAMPLES, 1)[0])


def _numbers(table: Any, tag: int, default: Any) -> tuple[float, ...]:
    """Return a tag's numbers as floats."""
    value = table.get(tag, default)
    if isinstance(value, bytes):
        value = struct.unpack(f"{len(value)}B", value)
    numbers = tuple(float(v) for v in (value if isinstance(value, tuple) else (value,)))
    if not numbers or not np.isfinite(numbers).all():
        raise ValueError(f"tag {tag} is {value!r:.60}")
    return numbers


def _raw_of(table: Any, first: Any) -> DngRaw:
    """Return the meaning of a raw image's directory. Raises ValueError and its kin for values that cannot be."""
    width, height = (int(table[tag]) for tag in (_WIDTH, _LENGTH))
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise ValueError(f"{width} x {height} pixels")
    samples = _samples(table)
    top, left, bottom, right = (int(v) for v in _numbers(table, _ACTIVE_AREA, (0.0, 0.0, height, width)))
    if not (0 <= top < bottom <= height and 0 <= left < right <= width):
        raise ValueError(f"ActiveArea {top, left, bottom, right} of {width} x {height}")
    rows, columns = (int(v) for v in _numbers(table, _BLACK_REPEAT, (1.0, 1.0)))
    if not (0 < rows <= _MAX_REPEAT and 0 < columns <= _MAX_REPEAT):
        raise ValueError(f"BlackLevelRepeatDim {rows, columns}")
    levels = _numbers(table, _BLACK, (0.0,))
    if len(levels) == 1:
        levels *= rows * columns * samples
    black = np.array(levels).reshape(rows, columns, samples)
    bits = int(max(_numbers(table, _BITS, (16,))))
    white = np.array(_numbers(table, _WHITE, (float(2**bits - 1),)))
    white = np.resize(white, samples)
    deltas = [
        np.array(_numbers(table, tag, 0.0)) if tag in table else np.zeros(size)
        for tag, size in ((_BLACK_DELTA_H, right - left), (_BLACK_DELTA_V, bottom - top))
    ]
    if len(deltas[0]) != right - left or len(deltas[1]) != bottom - top:
        raise ValueError("as many black level deltas as columns and rows")
    if not (white > black.max() + max(float(delta.max()) for delta in deltas)).all():
        raise ValueError(f"white level {white.tolist()} is not above black level {black.max():g}")
    scale = _numbers(table, _DEFAULT_SCALE, (1.0, 1.0))
    if len(scale) != 2 or not all(1 / _LARGEST_SCALE <= s <= _LARGEST_SCALE for s in scale):
        raise ValueError(f"DefaultScale {scale}")
    crop_left, crop_top = _numbers(table, _CROP_ORIGIN, (0.0, 0.0))
    crop_width, crop_height = _numbers(table, _CROP_SIZE, (right - left - crop_left, bottom - top - crop_top))
    inside = crop_left + crop_width <= right - left + 1e-6 and crop_top + crop_height <= bottom - top + 1e-6
    if not (inside and crop_left >= 0 and crop_top >= 0 and crop_width >= 1 and crop_height >= 1):
        raise ValueError(f"DefaultCrop {crop_left, crop_top, crop_width, crop_height}")
    orientation = first.get(_ORIENTATION, table.get(_ORIENTATION, 1))
    return DngRaw(
        size=(width, height),
        pattern=None if table[_PHOTOMETRIC] == _LINEAR_RAW else _pattern(table),
        active=(top, left, bottom, right),
        black=black,
        black_columns=deltas[0],
        black_rows=deltas[1],
        white=white,
        scale=(scale[0], scale[1]),
        crop=(crop_left, crop_top, crop_width, crop_height),
        orientation=orientation if orientation in range(1, 9) else 1,
        opcodes=tuple(bytes(table.get(tag, b"")) for tag in _OPCODE_LISTS),  # type: ignore[arg-type]
        tiles=_jpeg_tiles(table, width, height) if table.get(_COMPRESSION) == _LOSSY_JPEG else None,
    )


def _jpeg_tiles(table: Any, width: int, height: int) -> JpegTiles:
    """Return where a lossy DNG's pictures lie.

    Raises ValueError for a number of them that does not fill the image, or one of more bytes than its pixels need.
    """
    tiled = _TILE_WIDTH in table
    places, lengths = (_numbers(table, tags[0] if tiled else tags[1], ()) for tags in (_PLACES, _LENGTHS))
    rows = min(int(table.get(_ROWS_PER_STRIP, height)), height)  # 2^32 - 1 stands for one strip
    size = (int(table[_TILE_WIDTH]), int(table[_TILE_LENGTH])) if tiled else (width, rows)
    if min(size) < 1 or max(size) > _MAX_SIDE:
        raise ValueError(f"tiles of {size[0]} x {size[1]} pixels")
    count = -(-width // size[0]) * -(-height // size[1])
    if not len(places) == len(lengths) == count:
        raise ValueError(f"{len(places)} tiles, not {count}")
    if max(lengths) > (most := _MOST_JPEG + 6 * size[0] * size[1]):
        raise ValueError(f"a tile of {max(lengths):.0f} bytes, more than {most}")
    values = np.array(_numbers(table, _LINEARIZATION, 0.0), np.float32) if _LINEARIZATION in table else None
    parts = tuple((int(place), int(length)) for place, length in zip(places, lengths, strict=True))
    return JpegTiles(size, parts, values)
