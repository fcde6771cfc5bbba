"""Develop a DNG's samples by the file's own levels, opcode lists, crop and scale; LibRaw decodes and demosaics.

A color filter's mosaic is brought to light in multiples of each channel's white level first, and goes to LibRaw's
demosaicing as a plain file in memory, so that one range holds for all channels.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, TiffImagePlugin

from ...errors import InputError
from ..images.ldr_files import DAMAGED, PILLOW_ERRORS, turn_upright
from .dng import DngRaw, JpegTiles
from .dng_opcodes import apply_opcodes

CLIPPED = 0.99
"""Part of the clipping level from which a sample is clipped: a sensor reads it with noise, and demosaicing mixes it."""
# A sensor that clips below its stated white level does so above this part of it, and at more than this many pixels.
_LEAST_WHITE, _PILE = 0.75, 64


@dataclass(frozen=True)
class SensorLight:
    """A developed RAW photo."""

    light: np.ndarray  # [H, W, 3] float32 in the sensor's colors, 1 at the white level; more where a gain map says so
    clipped: np.ndarray  # [H, W, 3] bool, where the sensor clipped


def clipping_level(shares: np.ndarray) -> float:
    """Return where samples of a channel clip, as a part of the white level that they are stated in.

    The result is below 1 if pixels pile up at the largest value and no other value near it is nearly as frequent.
    """
    top = float(shares.max(initial=0))
    at_top, below = (shares > 0.995 * top).sum(), (shares > 0.95 * top).sum()
    return top if _LEAST_WHITE < top < 1 and at_top > max(_PILE, below / 4) else 1.0


def develop_dng(path: Path, dng: DngRaw, raw: Any, *, oriented: bool) -> SensorLight:
    """Return the light of a DNG that LibRaw has opened; `raw` is rawpy's open file.

    Raises:
        InputError: if the samples do not fit the tags, or an opcode list is damaged.
    """
    pattern = dng.pattern
    sensor = _decoded_by_libraw(path, dng, raw) if dng.tiles is None else _decoded_tiles(path, dng, dng.tiles)
    cell = 1 if pattern is None else len(pattern)
    if dng.opcodes[0]:
        sensor = apply_opcodes(dng.opcodes[0], sensor.astype(np.float32) / 65535, path, cell=cell) * 65535
    top, left, bottom, right = dng.active
    light = _normalize(sensor[top:bottom, left:right], dng)
    levels = np.ones(light.shape, np.float32)
    for channel in range(3):
        places = (..., channel) if pattern is None else (_places(light.shape, pattern, channel), 0)
        levels[places] = clipping_level(light[places])
    if dng.opcodes[1]:
        light = apply_opcodes(dng.opcodes[1], light, path, cell=cell)
        levels = apply_opcodes(dng.opcodes[1], levels, path, cell=cell)
    if pattern is not None:
        light, levels = (_demosaic(each[..., 0], pattern) for each in (light, levels))
    light, levels = (np.maximum(each, 0.0) for each in (light, levels))
    if dng.opcodes[2]:
        levels = apply_opcodes(dng.opcodes[2], levels, path)
        light = apply_opcodes(dng.opcodes[2], light, path)
    light, levels = (_crop(each, dng) for each in (light, levels))
    clipped = light >= CLIPPED * levels
    if oriented:
        light, clipped = (turn_upright(each, dng.orientation) for each in (light, clipped))
    return SensorLight(light, clipped)


def _decoded_by_libraw(path: Path, dng: DngRaw, raw: Any) -> np.ndarray:
    """Return the stored samples [H, W, 1 or 3]. Raises InputError if there are not as many as the tags state."""
    samples = 3 if dng.pattern is None else 1
    sensor = np.asarray(raw.raw_image)
    sensor = sensor.reshape(*sensor.shape[:2], -1)[:, :, :samples]
    height, width, channels = sensor.shape
    sensor = sensor[: dng.size[1], : dng.size[0]]  # LibRaw may pad to whole tiles.
    if sensor.shape != (dng.size[1], dng.size[0], samples):
        problem = (
            f"its tags state {dng.size[0]} x {dng.size[1]} pixels, LibRaw decodes {width} x {height} of {channels}"
        )
        raise InputError(path, problem, DAMAGED)
    return sensor


def _decoded_tiles(path: Path, dng: DngRaw, tiles: JpegTiles) -> np.ndarray:
    """Return the stored samples [H, W, 3] of a lossy DNG. Raises InputError if a picture is damaged."""
    (width, height), (across, down) = dng.size, tiles.size
    sensor = np.empty((height, width, 3), np.uint8 if tiles.linearization is None else np.float32)
    corners = ((top, left) for top in range(0, height, down) for left in range(0, width, across))
    with path.open("rb") as file:
        for (top, left), (place, length) in zip(corners, tiles.places, strict=True):
            part = sensor[top : top + down, left : left + across]
            try:
                file.seek(place)
                with Image.open(io.BytesIO(file.read(length)), formats=("JPEG", "MPO")) as picture:
                    if picture.width > across or picture.height > down:
                        raise ValueError(f"{picture.width} x {picture.height} pixels")
                    codes = np.asarray(picture)[: part.shape[0], : part.shape[1]]
            except PILLOW_ERRORS as error:
                raise InputError(path, f"a JPEG picture in it is damaged ({error!s:.80})", DAMAGED) from None
            if codes.shape != part.shape:
                raise InputError(path, f"a JPEG picture in it has the shape {codes.shape}, not {part.shape}", DAMAGED)
            table = tiles.linearization
            part[:] = codes if table is None else table[np.minimum(codes, len(table) - 1)]
    return sensor


def _places(shape: tuple[int, ...], pattern: np.ndarray, channel: int) -> np.ndarray:
    """Return [H, W] bool, where the filter has a channel."""
    height, width = shape[:2]
    repeats = -(-height // len(pattern)), -(-width // len(pattern))
    return np.tile(pattern == channel, repeats)[:height, :width]


def _normalize(sensor: np.ndarray, dng: DngRaw) -> np.ndarray:
    """Return [H, W, samples] float32: 0 at the black level, 1 at the white level of the same pixel and channel."""
    rows, columns, _ = dng.black.shape
    light = np.empty(sensor.shape, np.float32)
    for row in range(rows):
        for column in range(columns):
            black = dng.black[row, column] + dng.black_rows[row::rows, None, None]
            black = (black + dng.black_columns[column::columns][:, None]).astype(np.float32)
            part = sensor[row::rows, column::columns].astype(np.float32)
            light[row::rows, column::columns] = (part - black) / (dng.white.astype(np.float32) - black)
    return light


def _demosaic(mosaic: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Return [H, W, 3] float32 in the sensor's colors from a mosaic [H, W], by LibRaw."""
    import rawpy

    channels = [mosaic[_places(mosaic.shape, pattern, channel)] for channel in range(3)]
    if all(values.min() == values.max() for values in channels):
        return np.broadcast_to(np.array([values[0] for values in channels], np.float32), (*mosaic.shape, 3))
    headroom = max(1.0, float(mosaic.max()))
    with rawpy.imread(io.BytesIO(_plain_dng(mosaic / headroom, pattern))) as raw:
        return linear_colors(raw, user_flip=0) * np.float32(headroom)


def linear_colors(raw: Any, user_flip: int | None) -> np.ndarray:
    """Return [H, W, 3] float32 in [0, 1] that LibRaw demosaics of an open file, in the sensor's colors as they are."""
    import rawpy

    options: dict[str, Any] = {"output_color": rawpy.ColorSpace.raw, "gamma": (1, 1), "output_bps": 16}
    options |= {"no_auto_bright": True, "user_wb": [1, 1, 1, 1], "adjust_maximum_thr": 0.0, "user_flip": user_flip}
    linear = raw.postprocess(**options).astype(np.float32)
    linear /= 65535
    return linear


def _plain_dng(mosaic: np.ndarray, pattern: np.ndarray) -> bytes:
    """Return a DNG of 16-bit samples with black level 0 and white level 65535."""
    height, width = mosaic.shape
    samples = np.rint(np.clip(mosaic, 0, 1) * 65535).astype("<u2")
    size, cells = len(pattern), bytes(int(channel) for channel in pattern.ravel())
    short, long, byte, text, rational, signed = 3, 4, 1, 2, 5, 10
    tags: dict[int, tuple[int, Any]] = {
        254: (long, 0), 256: (long, width), 257: (long, height), 258: (short, 16), 259: (short, 1),
        262: (short, 32803), 271: (text, "plain"), 272: (text, "plain"), 273: (long, 0), 277: (short, 1),
        278: (long, height), 279: (long, samples.nbytes), 33421: (short, (size, size)), 33422: (byte, cells),
        50706: (byte, bytes([1, 4, 0, 0])), 50708: (text, "plain"), 50714: (long, 0), 50717: (long, 65535),
        50721: (signed, (1, 0, 0, 0, 1, 0, 0, 0, 1)), 50728: (rational, (1, 1, 1)), 50778: (short, 21),
    }  # fmt: skip
    directory = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, (kind, value) in tags.items():
        directory.tagtype[tag] = kind
        directory[tag] = value
    file = io.BytesIO()
    directory.save(file)  # Adds its end to the place of the samples, tag 273.
    return file.getvalue() + samples.tobytes()


def _crop(image: np.ndarray, dng: DngRaw) -> np.ndarray:
    """Return the default crop of an image of the active area [H, W, 3], with square pixels."""
    from scipy.ndimage import map_coordinates

    (width, height), (left, top, *_) = dng.sizes[0], dng.crop
    if dng.scale == (1.0, 1.0):
        left, top = min(round(left), image.shape[1] - width), min(round(top), image.shape[0] - height)
        return np.ascontiguousarray(image[top : top + height, left : left + width])
    across = left + (np.arange(width) + 0.5) / dng.scale[0] - 0.5
    down = top + (np.arange(height) + 0.5) / dng.scale[1] - 0.5
    result = np.empty((height, width, image.shape[2]), np.float32)
    places = np.stack(np.meshgrid(down, across, indexing="ij"))
    for channel in range(image.shape[2]):
        result[..., channel] = map_coordinates(image[..., channel], places, order=1, mode="nearest")
    return result
