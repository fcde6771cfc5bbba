"""Radiance pictures (.hdr; shared-exponent RGBE; Ward, Graphics Gems II, II.5), uncompressed."""

from pathlib import Path

import numpy as np

from ..files import atomic_path
from .exr import check_finite


def write_radiance(path: Path | str, image: np.ndarray, *, exposure: float = 1.0, overwrite: bool = False) -> None:
    """Write [H, W, 3] linear RGB as Radiance HDR; negative values become 0 and channels share an 8-bit exponent.

    Args:
        path: The file.
        image: The picture.
        exposure: Factor that radiance was multiplied by, written as EXPOSURE.
        overwrite: Replace a file that exists.

    Raises:
        InputError: If a value is NaN or infinite (with its place) or `path` exists.
    """
    check_finite(Path(path), image, "{count} values")
    image = np.clip(np.asarray(image, np.float64), 0, 1.7e38)
    largest = image.max(axis=2)
    mantissa, exponent = np.frexp(largest)
    scale = np.where(largest > 1e-32, mantissa * 256 / np.where(largest > 0, largest, 1), 0)
    codes = np.concatenate(
        [np.floor(image * scale[..., None]), (exponent + 128)[..., None] * (scale > 0)[..., None]], 2
    )
    height, width = largest.shape
    exposure_line = "" if exposure == 1 else f"EXPOSURE={exposure:.9g}\n"
    head = f"#?RADIANCE\nSOFTWARE=sehdr-warp\n{exposure_line}FORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    with atomic_path(path, overwrite) as temporary:
        temporary.write_bytes(head.encode() + codes.astype(np.uint8).tobytes())
