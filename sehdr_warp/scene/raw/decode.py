"""A camera's RAW files: LibRaw's photos, in 16-bit codes of sRGB's curve, so that there is no response to guess.

Light stays in the sensor's own colors, without white balance: there each channel clips at its own white level, code
65535. One matrix (Scene.color_matrix) leads from there to Rec.709, with the white balance of the set's first photo.
"""

import contextlib
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import InputError, require_extra
from ...quiet import silent_stderr
from ..color.primaries import linear_to_srgb
from ..images.ldr_files import EncodedImage, check_size, require_file
from ..types import codes_of
from .dng import DngRaw, read_dng
from .dng_develop import CLIPPED, clipping_level, develop_dng, linear_colors

_XYZ_FROM_REC709 = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_NOISE = 0.02  # Standard deviation of the logarithm of light near white, from a sensor's noise and demosaicing
_REMEDY = "develop the photos as JPEG, PNG or TIFF, or convert them to DNG"


class RawHeader(NamedTuple):
    """Statements of a RAW file beside its pixels; None for an exposure that it does not state."""

    size: tuple[int, int]  # (width, height) of the developed photo as the sensor lies
    upright_size: tuple[int, int]  # Of the photo turned upright
    exposure_time: float | None  # Seconds
    iso: float | None  # ISO speed
    f_number: float | None  # Focal length over aperture
    matrix: np.ndarray  # [3, 3] from the sensor's white-balanced colors to linear Rec.709; zero without it
    balance: tuple[float, ...]  # Factors of red, green and blue on the sensor's colors; empty without them


def read_header(path: Path) -> RawHeader:
    """Read the header of a RAW file, once for a file that stays as it is.

    Raises:
        InputError: if the file is missing or damaged, too large, or holds what LibRaw does not decode.
    """
    require_file(path)
    stat = path.stat()
    return _header(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4096)
def _header(path: Path, changed: int, length: int) -> RawHeader:
    dng = read_dng(path)
    with _open(path, dng) as raw:
        size, turned = (raw.sizes.width, raw.sizes.height), (raw.sizes.height, raw.sizes.width)
        sizes = (size, turned if raw.sizes.flip in (5, 6) else size) if dng is None else dng.sizes
        exposure = (raw.other.shutter_speed, raw.other.iso_speed, raw.other.aperture)
        matrix, xyz_matrix = np.array(raw.color_matrix)[:, :3], np.array(raw.rgb_xyz_matrix)[:3]
        balances = (tuple(each[:3]) for each in (raw.camera_whitebalance, raw.daylight_whitebalance))
        balance = next((each for each in balances if min(each) > 0), ())
    check_size(path, *sizes[0])
    if not matrix.any() and xyz_matrix.any():
        to_camera = xyz_matrix @ _XYZ_FROM_REC709
        matrix = np.linalg.inv(to_camera / to_camera.sum(axis=1, keepdims=True))
    time, iso, f_number = (value if value > 0 else None for value in exposure)
    return RawHeader(*sizes, time, iso, f_number, matrix, balance)


def read_raw(path: Path, *, oriented: bool) -> EncodedImage:
    """Return the codes of a RAW file, and the light above white that a DNG's gain map states.

    The codes are [H, W, 3] uint16 by sRGB's curve in the sensor's colors, 1 at each channel's white level.

    Raises:
        InputError: if the file is missing or damaged, or holds what LibRaw does not decode.
    """
    read_header(path)  # Checks the size.
    dng = read_dng(path)
    with _open(path, dng) as raw:
        if dng is None:
            linear = _develop(raw, oriented)
            return EncodedImage(linear_codes(linear), None)
        sensor = develop_dng(path, dng, raw, oriented=oriented)
    codes = linear_codes(np.where(sensor.clipped, 1, sensor.light))
    overflow = (codes == 65535) & ~sensor.clipped
    above = np.where(overflow, np.maximum(sensor.light, 1), 0).astype(np.float16) if overflow.any() else None
    return EncodedImage(codes, None, above, _NOISE)


def _develop(raw: Any, oriented: bool) -> np.ndarray:
    """Return [H, W, 3] float32 light of an opened RAW file, 1 where a channel clips."""
    levels, values, colors = np.ones(3), raw.raw_image_visible, raw.raw_colors_visible
    black, ranges = np.array(raw.black_level_per_channel, float), np.ones(3)
    for channel, members in enumerate(((0,), (1, 3), (2,))):
        shares = values[np.isin(colors, members)].astype(np.float32) - black[channel]
        levels[channel] = clipping_level(shares / (raw.white_level - black[channel]))
        # LibRaw divides all channels by the range of the one with the lowest black level.
        ranges[channel] = (raw.white_level - black.min()) / (raw.white_level - black[list(members)].mean())
    linear = linear_colors(raw, user_flip=None if oriented else 0)
    linear *= ranges.astype(np.float32)
    return np.where(linear >= CLIPPED * levels, 1, linear)


def linear_codes(linear: np.ndarray) -> np.ndarray:
    """Return [H, W, 3] uint16 sRGB codes of a sensor's light, which is 1 at white; from 0.99 on it counts as white.

    The codes of a curve keep more of the dark than 16 linear bits.
    """
    return codes_of(linear_to_srgb(np.where(linear >= CLIPPED, 1, linear)), 16)


def color_matrix(photos: Sequence[Path]) -> np.ndarray:
    """Return [3, 3] from the sensor's colors to linear Rec.709, with the white balance of the first photo.

    Raises:
        InputError: if a file states no colors, or the photos are of different cameras.
    """
    first, *_ = headers = [read_header(photo) for photo in photos]
    for photo, header in zip(photos, headers, strict=True):
        if not header.matrix.any() or not header.balance:
            raise InputError(photo, "states no color matrix or white balance of its camera", _REMEDY)
        if not np.allclose(header.matrix, first.matrix, atol=1e-3):
            raise InputError(photo, f"is of another camera than {photos[0].name}", "keep the photos of one camera")
    return first.matrix * (np.array(first.balance) / min(first.balance))


@contextlib.contextmanager
def _open(path: Path, dng: DngRaw | None) -> Iterator[Any]:
    """Open a RAW file by LibRaw; raise InputError if it cannot."""
    rawpy = require_extra("rawpy", f"{path}: RAW files need rawpy", "raw")
    try:
        # LibRaw prints of damage, too.
        with silent_stderr(), rawpy.imread(str(path)) as raw:
            # Linear raw has no filter; what has neither, or other colors, is not a photo of a camera known here.
            linear = raw.raw_pattern is None and raw.raw_type == rawpy.RawType.Stack and dng is not None
            if raw.num_colors != 3 or not (linear or raw.raw_pattern is not None):
                raise InputError(path, "is not a photo through a filter of three colors", _REMEDY)
            yield raw
    except rawpy.LibRawError as error:
        reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        raise InputError(path, f"cannot be read as RAW ({reason})", "copy the file again") from None
