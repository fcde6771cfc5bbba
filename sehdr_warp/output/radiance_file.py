"""Radiance pictures (.hdr; shared-exponent RGBE; Ward, Graphics Gems II, II.5), uncompressed."""

from pathlib import Path

import numpy as np

from ..files import atomic_path
from .exr import check_finite


def write_radiance(path: Path | str, image: np.ndarray, *, exposure: float = 1.0, overwrite: bool = False) -> None:
    """Writes [H, W, 3] linear RGB, of which negative values become 0; a pixel's channels share an exponent of 8 bits.
    exposure: what radiance was multiplied by, as the header's EXPOSURE states.

    Raises InputError where a value is NaN or infinite (with its place) or `path` exists (unless overwrite).
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
    stated = "" if exposure == 1 else f"EXPOSURE={exposure:.9g}\n"
    head = f"#?RADIANCE\nSOFTWARE=sehdr-warp\n{stated}FORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    with atomic_path(path, overwrite) as temporary:
        temporary.write_bytes(head.encode() + codes.astype(np.uint8).tobytes())
