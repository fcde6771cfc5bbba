"""Write pictures: PNG with 8 or 16 bits and JPEG with EXIF exposure times.

Reading is in scene/images/ldr_files.py.
"""

import io
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from ...files import atomic_path
from ...scene.images.ldr_files import png16

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
    """Return EXIF with an exposure time in seconds, as the nearest 32-bit rational; `bias` is in stops."""
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
            temporary.write_bytes(png16(codes, None if exif is None else exif.tobytes().removeprefix(b"Exif\0\0")))
        else:
            Image.fromarray(codes).save(temporary, exif=exif or Image.Exif(), **options)


def jpeg(encoded: np.ndarray, quality: int = 88, **options: Any) -> bytes:
    """Encode [H, W] or [H, W, 3] sRGB values in [0, 1] as JPEG; options are Pillow's."""
    buffer = io.BytesIO()
    Image.fromarray(quantize(encoded)).save(buffer, "JPEG", quality=quality, optimize=True, **options)
    return buffer.getvalue()
