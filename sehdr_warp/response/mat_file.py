"""Matrices of real numbers from MATLAB's .mat files of version 5 (MAT-File Format, The MathWorks, R2019b).

Every length is checked against the bytes that are left before it is believed: scipy's loadmat believes them, and a
damaged file ends the process.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

MOST_BYTES = 256 * 2**20
"""Of a compressed variable once it is unpacked."""

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_REAL_CLASSES = range(6, 16)
"""Of arrays: double, single and the integers; not cells, structures, objects, text or sparse ones."""


def read_matrices(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The real matrices of these names in a file, [rows, columns] float64; what it does not hold is left out.

    Raises ValueError for a file of another format, or one that is damaged; OSError if it cannot be read.
    """
    data = path.read_bytes()
    if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("no MAT-file of version 5")
    order = "<" if data[126:128] == b"IM" else ">"
    found = {}
    for kind, content in _elements(data[128:], order):
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            try:
                unpacked = unpacker.decompress(content, MOST_BYTES)
            except zlib.error as error:
                raise ValueError(f"a compressed variable is damaged ({error})") from None
            if unpacker.unconsumed_tail:
                raise ValueError(f"a variable has more than {MOST_BYTES} bytes")
            kind, content = next(_elements(unpacked, order), (0, b""))
        if kind == _MATRIX:
            name, matrix = _matrix(content, order, names)
            if matrix is not None:
                found[name] = matrix
    return found


def _elements(data: bytes, order: str):
    """(type, content) of one data element after the other."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        if kind >> 16:  # a small element keeps its size beside its type, and up to 4 bytes of content behind
            kind, size, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
            if size > 4:
                raise ValueError(f"a small element of {size} bytes")
        else:
            start = at + 8
            # Elements end at multiples of 8 bytes, compressed ones wherever they end.
            step = 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        if start + size > len(data):
            raise ValueError(f"an element of {size} bytes, where {len(data) - start} are left")
        yield kind, data[start : start + size]
        at += step


def _matrix(content: bytes, order: str, names: tuple[str, ...]) -> tuple[str, np.ndarray | None]:
    parts = list(_elements(content, order))
    if len(parts) < 3 or len(parts[0][1]) < 4:
        raise ValueError("a matrix without flags, size or name")
    (flags,) = struct.unpack_from(order + "I", parts[0][1])
    name = parts[2][1].decode("latin-1")
    if name not in names:
        return name, None
    if (flags & 0xFF) not in _REAL_CLASSES or len(parts) != 4 or parts[3][0] not in _NUMBERS:
        raise ValueError(f"{name} is no matrix of real numbers")
    shape = np.frombuffer(parts[1][1][: len(parts[1][1]) // 4 * 4], order + "i4").astype(np.int64)
    kind = np.dtype(order + _NUMBERS[parts[3][0]])
    values = np.frombuffer(parts[3][1][: len(parts[3][1]) // kind.itemsize * kind.itemsize], kind)
    if len(shape) != 2 or (shape < 0).any() or int(shape[0]) * int(shape[1]) != len(values):
        raise ValueError(f"{name} is of size {shape.tolist()[:4]}, but has {len(values)} numbers")
    return name, values.astype(np.float64).reshape(shape, order="F")
