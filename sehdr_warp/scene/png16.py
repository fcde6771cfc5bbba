"""16-bit color PNG, which Pillow reads and does not write (PNG specification, 3rd edition: 5, 9 and 11.3.3)."""

import struct
import zlib

import numpy as np


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
