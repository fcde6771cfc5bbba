"""Encoded pictures: PNG with 8 or 16 bits and JPEG, with EXIF exposure times. Reading is in scene/images.py."""

import struct
import zlib
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from ..files import atomic_path

_EXIF_IFD, _EXPOSURE_TIME, _EXPOSURE_BIAS, _SOFTWARE, _DATE = 0x8769, 0x829A, 0x9204, 0x0131, 0x9003
EXIF_TIME = "%Y:%m:%d %H:%M:%S"


def quantize(values: np.ndarray, bits: int = 8) -> np.ndarray:
    """Convert encoded values in [0, 1] to code values: uint8 or, with 16 bits, uint16.

    Values are rounded to nearest and limited to [0, 1]; NaN raises ValueError.
    """
    if np.isnan(values).any():
        raise ValueError("the picture holds NaN")
    white = 2**bits - 1
    return np.rint(np.clip(values, 0, 1) * np.float64(white)).astype(np.uint8 if bits == 8 else np.uint16)


def exposure_exif(exposure_time: float, *, bias: float | None = None, captured: datetime | None = None) -> Image.Exif:
    """Return EXIF with an exposure time.

    Args:
        exposure_time: Seconds, stored as the nearest 32-bit rational.
        bias: ExposureBiasValue in stops.
        captured: DateTimeOriginal.
    """
    exif = Image.Exif()
    exif[_SOFTWARE] = "sehdr-warp"
    details = exif.get_ifd(_EXIF_IFD)
    details[_EXPOSURE_TIME] = IFDRational(Fraction(exposure_time).limit_denominator(10**6))
    if bias is not None:
        details[_EXPOSURE_BIAS] = IFDRational(Fraction(bias).limit_denominator(10**6))
    if captured is not None:
        details[_DATE] = captured.strftime(EXIF_TIME)
    return exif


def write_picture(path: Path | str, codes: np.ndarray, *, exif: Image.Exif | None = None) -> None:
    """Write [H, W, 3] code values as PNG (uint8, uint16) or, by a .jpg suffix, JPEG without chroma subsampling (uint8).

    Raises InputError and SehdrError as atomic_path does, and ValueError for another type.
    """
    jpeg = Path(path).suffix == ".jpg"
    if codes.dtype not in ((np.uint8,) if jpeg else (np.uint8, np.uint16)):
        raise ValueError(f"code values are {codes.dtype}, not uint8{'' if jpeg else ' or uint16'}")
    options: dict[str, Any] = {"quality": 98, "subsampling": 0} if jpeg else {}
    with atomic_path(path) as temporary:
        if codes.dtype == np.uint16:
            temporary.write_bytes(_png16(codes, exif))
        else:
            Image.fromarray(codes).save(temporary, exif=exif or Image.Exif(), **options)


def as_array(value) -> np.ndarray:
    """Return a torch tensor on any device, or an array, as an array."""
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)


def _png16(codes: np.ndarray, exif: Image.Exif | None) -> bytes:
    """Return a 16-bit color PNG, which Pillow cannot write (PNG specification, 3rd edition: 5, 9 and 11.3.3)."""
    height, width = codes.shape[:2]
    rows = codes.astype(">u2").reshape(height, -1).view(np.uint8)
    # Each row's filter, 2, is "Up": each byte less the one above it.
    filtered = np.insert(np.diff(rows, axis=0, prepend=np.uint8(0)), 0, 2, axis=1)
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    exif_data = {} if exif is None else {b"eXIf": exif.tobytes().removeprefix(b"Exif\0\0")}
    written = b"\x89PNG\r\n\x1a\n"
    for kind, data in {b"IHDR": header, **exif_data, b"IDAT": zlib.compress(filtered.tobytes()), b"IEND": b""}.items():
        written += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return written
