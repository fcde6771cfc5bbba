"""Photos that hold light itself: a camera's RAW files, linear 16-bit photos, and OpenEXR and Radiance pictures.

They become 16-bit codes of a curve of this package's own choice, so there is no response to guess. RAW stays in the
sensor's own colors, without white balance: there each channel clips at its own white level, which is code 65535. One
matrix (Scene.color_matrix) leads from there to Rec.709, with the white balance of the set's first photo.
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, SehdrError
from ..quiet import silent_stderr
from .capture import reinhard_gamma
from .hdr_files import read_hdr
from .images import HDR_SUFFIXES, RAW_SUFFIXES, check_size, require_file
from .types import codes_of

CURVES = {"raw": "srgb", "linear": "srgb", "float": "hdr-nerf"}
"""The response of each kind's codes. Float pictures have no white level, nor has Reinhard's curve."""
_XYZ_FROM_REC709 = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
# What clips is not at white to the last bit: a sensor reads it out with noise, and demosaicing mixes it with others.
_CLIPPED = 0.99
# Sensors that clip below the white level that is stated do so above this part of it, and at so many pixels.
_LEAST_WHITE, _PILE = 0.75, 64
_MIDDLE_GREY = 0.18
_MOST_JUDGED = 24
_REMEDY = "develop the photos as JPEG, PNG or TIFF, or convert them to DNG"


def kind_of(path: Path) -> str:
    """raw, float or encoded, by the suffix."""
    suffix = path.suffix.lower()
    return "raw" if suffix in RAW_SUFFIXES else "float" if suffix in HDR_SUFFIXES else "encoded"


def one_kind(photos: Sequence[Path]) -> str:
    """The kind of all photos of a set; InputError where they differ."""
    kinds = [kind_of(photo) for photo in photos]
    other = next((photo for photo, kind in zip(photos, kinds, strict=True) if kind != kinds[0]), None)
    if other is not None:
        problem = f"is {kind_of(other)}, and {photos[0].name} is {kinds[0]}: photos of one set are of one kind"
        raise InputError(other, problem, "keep one kind in the folder")
    return kinds[0]


def float_codes(radiance: np.ndarray, time: float) -> np.ndarray:
    """[H, W, 3] uint16 codes of linear values at an exposure time."""
    return codes_of(reinhard_gamma(radiance * time), 16)


def float_time(photos: Sequence[Path]) -> float:
    """The exposure time at which a set of float pictures is exposed well: its log-average is middle grey."""
    chosen = photos[:: -(-len(photos) // _MOST_JUDGED)]
    return _MIDDLE_GREY / float(np.exp(np.mean([np.log(_log_average(read_hdr(photo))) for photo in chosen])))


def tone_mapped(path: Path) -> np.ndarray:
    """[H, W, 3] uint8 of a float picture by itself, for the eye and for structure from motion."""
    radiance = read_hdr(path)
    return codes_of(reinhard_gamma(radiance * _MIDDLE_GREY / _log_average(radiance)), 8)


def raw_sizes(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """(width, height) of the developed photo as the sensor lies, and turned upright."""
    with _opened(path) as raw:
        width, height = raw.sizes.width, raw.sizes.height
        check_size(path, width, height)
        return (width, height), (height, width) if raw.sizes.flip in (5, 6) else (width, height)


def raw_codes(path: Path, *, oriented: bool) -> np.ndarray:
    """[H, W, 3] uint16 sRGB codes of a RAW file in the sensor's colors, 1 at each channel's white level."""
    raw_sizes(path)
    with _opened(path) as raw:
        import rawpy

        options: dict[str, Any] = {"output_color": rawpy.ColorSpace.raw, "gamma": (1, 1), "output_bps": 16}
        options |= {"no_auto_bright": True, "user_wb": [1, 1, 1, 1], "adjust_maximum_thr": 0.0}
        linear = raw.postprocess(**options, user_flip=None if oriented else 0).astype(np.float32) / 65535
        clipped = linear >= _CLIPPED * _saturation(raw)
    return linear_codes(np.where(clipped, 1, linear))


def _saturation(raw: Any) -> np.ndarray:
    """[3] where each channel of an opened RAW file clips, as a share of the white level that is known of its camera:
    below 1 where pixels pile up at their largest value, and no other near it is as frequent by far."""
    levels, values, colors = np.ones(3), raw.raw_image_visible, raw.raw_colors_visible
    for channel, members in enumerate(((0,), (1, 3), (2,))):
        black = raw.black_level_per_channel[channel]
        shares = (values[np.isin(colors, members)].astype(np.float32) - black) / (raw.white_level - black)
        top = shares.max(initial=0)
        at_top, below = (shares > 0.995 * top).sum(), (shares > 0.95 * top).sum()
        if _LEAST_WHITE < top < 1 and at_top > max(_PILE, below / 4):
            levels[channel] = top
    return levels


def linear_codes(linear: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint16 sRGB codes of a sensor's light, 1 at white: of 16 linear bits, what the dark keeps is what
    matters. From 0.99 on it counts as white."""
    linear = np.where(linear >= _CLIPPED, 1, linear)
    bright = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return codes_of(np.where(linear <= 0.0031308, 12.92 * linear, bright), 16)


def raw_exposure(path: Path) -> tuple[float | None, float | None, float | None]:
    """Exposure time in seconds, ISO speed and f-number that a RAW file states, None where it does not."""
    with _opened(path) as raw:
        stated = raw.other
        return tuple(v if v > 0 else None for v in (stated.shutter_speed, stated.iso_speed, stated.aperture))  # type: ignore[return-value]


def color_matrix(photos: Sequence[Path]) -> np.ndarray:
    """[3, 3] from the sensor's colors to linear Rec.709, with the white balance of the first photo.

    InputError where a file states no colors, or the photos are of different cameras.
    """
    first = None
    for photo in photos:
        with _opened(photo) as raw:
            matrix, stated = np.array(raw.color_matrix)[:, :3], np.array(raw.rgb_xyz_matrix)[:3]
            if not matrix.any() and stated.any():
                to_camera = stated @ _XYZ_FROM_REC709
                matrix = np.linalg.inv(to_camera / to_camera.sum(axis=1, keepdims=True))
            balance = next((b for b in (raw.camera_whitebalance, raw.daylight_whitebalance) if min(b[:3]) > 0), None)
        if not matrix.any() or balance is None:
            raise InputError(photo, "states no color matrix or white balance of its camera", _REMEDY)
        if first is None:
            first = matrix, np.array(balance[:3]) / min(balance[:3])
        elif not np.allclose(matrix, first[0], atol=1e-3):
            raise InputError(photo, f"is of another camera than {photos[0].name}", "keep the photos of one camera")
    assert first is not None
    return first[0] * first[1]


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    require_file(path)
    try:
        import rawpy
    except ImportError:
        raise SehdrError(f"{path}: RAW files need rawpy; pip install 'sehdr-warp[raw]'") from None
    try:
        # LibRaw prints of damage, too.
        with silent_stderr(), rawpy.imread(str(path)) as raw:
            if raw.raw_pattern is None or raw.num_colors != 3:
                raise InputError(path, "is no photo through a filter of three colors", _REMEDY)
            yield raw
    except rawpy.LibRawError as error:
        reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        raise InputError(path, f"cannot be read as RAW ({reason})", "copy the file again") from None


def _log_average(radiance: np.ndarray) -> float:
    mean = radiance.mean(axis=2)
    bright = float(np.percentile(mean, 99))
    if not bright > 0:
        return 1.0
    return float(np.exp(np.log(np.maximum(mean, bright * 1e-6)).mean()))
