"""DNG's opcode lists (Adobe's DNG specification 1.7, chapter 7): shading maps, bad pixels, vignetting, lens distortion.

Phones and drones leave lens shading to a GainMap; without it the corners of their photos are dark and tinted.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import InputError
from ..images.ldr_files import DAMAGED

_OPTIONAL = 1  # Flag: a reader that does not know the opcode may skip it
_TRIM_BOUNDS = 6  # DNG leaves open whether the default crop and later opcodes count from the trimmed image
_MOST_OPCODES = 64  # Files have up to a dozen; each may cost a pass over the picture
_LARGEST_DEGREE = 8


class _Reader:
    """A big-endian cursor over the bytes of one opcode. Raises ValueError past their end.

    `cell` is the side of the color filter's pattern in pixels, 1 without one: pixels so far apart have one color.
    """

    def __init__(self, data: bytes, cell: int = 1):
        self.data, self.cell, self.position = data, cell, 0

    def take(self, layout: str) -> tuple:
        size = struct.calcsize(f">{layout}")
        if self.position + size > len(self.data):
            raise ValueError(f"ends early, at byte {len(self.data)}")
        self.position += size
        return struct.unpack_from(f">{layout}", self.data, self.position - size)

    def array(self, kind: str, count: int) -> np.ndarray:
        (data,) = self.take(f"{np.dtype(kind).itemsize * count}s")
        return np.frombuffer(data, f">{kind}").astype(np.float64)


class _Area(NamedTuple):
    """Rows and columns of an image [H, W, planes] that an opcode changes, and views [h, w] of them for each plane."""

    rows: slice
    columns: slice
    parts: list[np.ndarray]


def _area(reader: _Reader, image: np.ndarray) -> _Area:
    top, left, bottom, right, plane, planes, row_pitch, column_pitch = reader.take("8I")
    if row_pitch < 1 or column_pitch < 1 or plane >= image.shape[2]:
        raise ValueError(f"pitches {row_pitch}, {column_pitch}, first plane {plane} of {image.shape[2]}")
    rows = slice(top, min(bottom, image.shape[0]), row_pitch)
    columns = slice(left, min(right, image.shape[1]), column_pitch)
    parts = [image[rows, columns, each] for each in range(plane, min(plane + planes, image.shape[2]))]
    return _Area(rows, columns, [part for part in parts if part.size])


def apply_opcodes(data: bytes, image: np.ndarray, source: Path, *, cell: int = 1) -> np.ndarray:
    """Apply an opcode list to an image.

    Args:
        data: the list as the file holds it; may be empty.
        image: [H, W, planes] float32 in the units of the list: stored samples / 65535 for the first list, light in
            multiples of the white level for the others. Changed in place.
        source: the file, for errors.
        cell: side of the color filter's pattern in pixels, 1 without one.

    Returns:
        The image; a new array if an opcode moved pixels.

    Raises:
        InputError: if the list is damaged, or demands an opcode that is not known here.
    """
    for number, flags, body in _opcodes(data, source):
        function = _FUNCTIONS.get(number)
        try:
            if function is not None:
                image = function(_Reader(body, cell), image)
            elif not flags & _OPTIONAL:
                name = " (TrimBounds)" if number == _TRIM_BOUNDS else ""
                problem = f"demands opcode {number}{name} of DNG, which is not supported"
                raise InputError(source, problem, "develop the photos as JPEG, PNG or TIFF")
        except (ValueError, struct.error, OverflowError, MemoryError) as error:
            raise InputError(source, f"its DNG opcode {number} is damaged ({error!s:.80})", DAMAGED) from None
    return image


def _opcodes(data: bytes, source: Path) -> Iterator[tuple[int, int, bytes]]:
    """Yield number, flags and parameters of each opcode."""
    if not data:
        return
    reader = _Reader(data)
    try:
        (count,) = reader.take("I")
        if count > _MOST_OPCODES:
            raise ValueError(f"{count} opcodes")
        for _ in range(count):
            number, _, flags, size = reader.take("4I")
            yield number, flags, bytes(reader.take(f"{size}s")[0])
    except (ValueError, struct.error, OverflowError, MemoryError) as error:
        raise InputError(source, f"its list of DNG opcodes is damaged ({error!s:.80})", DAMAGED) from None


def _gain_map(reader: _Reader, image: np.ndarray) -> np.ndarray:
    """Multiply by a grid of gains, interpolated bilinearly; places are relative to the image's size."""
    from scipy.interpolate import RectBivariateSpline

    area = _area(reader, image)
    points_v, points_h = reader.take("2I")
    spacing_v, spacing_h, origin_v, origin_h = reader.take("4d")
    (planes,) = reader.take("I")
    if not (points_v and points_h and planes and np.isfinite([spacing_v, spacing_h, origin_v, origin_h]).all()):
        raise ValueError("no points, or none at places that are finite")
    gains = reader.array("f4", points_v * points_h * planes).reshape(points_v, points_h, planes)
    if not np.isfinite(gains).all() or gains.min() < 0:
        raise ValueError("gains below zero or not finite")

    def places(pixels: slice, count: int, origin: float, spacing: float) -> np.ndarray:
        relative = (np.arange(count)[pixels] + 0.5) / count - origin
        return relative / spacing if spacing > 0 else np.zeros_like(relative)

    down = places(area.rows, image.shape[0], origin_v, spacing_v)
    right = places(area.columns, image.shape[1], origin_h, spacing_h)
    for place, part in enumerate(area.parts):
        # A spline has two points at least.
        grid = np.pad(gains[:, :, min(place, planes - 1)], ((0, points_v == 1), (0, points_h == 1)), mode="edge")
        spline = RectBivariateSpline(np.arange(grid.shape[0]), np.arange(grid.shape[1]), grid, kx=1, ky=1)
        part *= spline(down, right).astype(np.float32)
    return image


def _fix_bad_pixels_constant(reader: _Reader, image: np.ndarray) -> np.ndarray:
    constant, _ = reader.take("2I")
    return _fill(image, np.rint(image * 65535) == constant, reader.cell)


def _fix_bad_pixels_list(reader: _Reader, image: np.ndarray) -> np.ndarray:
    _, points, rectangles = reader.take("3I")
    bad = np.zeros(image.shape, bool)
    places = reader.array("u4", 2 * points).astype(int).reshape(-1, 2)
    places = places[(places < image.shape[:2]).all(axis=1)]
    bad[places[:, 0], places[:, 1]] = True
    for top, left, bottom, right in reader.array("u4", 4 * rectangles).astype(int).reshape(-1, 4):
        bad[top:bottom, left:right] = True
    return _fill(image, bad, reader.cell)


def _fill(image: np.ndarray, bad: np.ndarray, cell: int) -> np.ndarray:
    """Replace bad pixels by the mean of the good ones of the same color around them."""
    rows, columns, planes = np.nonzero(bad)
    total, count = np.zeros(len(rows)), np.zeros(len(rows))
    for down in (-cell, 0, cell):
        for right in (-cell, 0, cell):
            y, x = rows + down, columns + right
            inside = (y >= 0) & (y < image.shape[0]) & (x >= 0) & (x < image.shape[1])
            y, x = np.where(inside, y, rows), np.where(inside, x, columns)
            good = inside & ~bad[y, x, planes]
            total += np.where(good, image[y, x, planes], 0)
            count += good
    image[rows, columns, planes] = np.where(count > 0, total / np.maximum(count, 1), image[rows, columns, planes])
    return image


def _map_table(reader: _Reader, image: np.ndarray) -> np.ndarray:
    area = _area(reader, image)
    (count,) = reader.take("I")
    table = (reader.array("u2", count) / 65535).astype(np.float32)
    if not count:
        raise ValueError("no table")
    for part in area.parts:
        part[:] = table[np.clip(np.rint(part * 65535), 0, count - 1).astype(int)]
    return image


def _map_polynomial(reader: _Reader, image: np.ndarray) -> np.ndarray:
    area = _area(reader, image)
    (degree,) = reader.take("I")
    if degree > _LARGEST_DEGREE:
        raise ValueError(f"degree {degree}")
    terms = reader.array("f8", degree + 1)
    for part in area.parts:
        part[:] = np.polynomial.polynomial.polyval(part, terms)
    return image


def _along(axis: int, combine: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable:
    """Return the function of DeltaPerRow and its kin: combine each row (axis 0) or column (axis 1) with a number."""

    def apply(reader: _Reader, image: np.ndarray) -> np.ndarray:
        area = _area(reader, image)
        (count,) = reader.take("I")
        values = reader.array("f4", count).astype(np.float32)
        for part in area.parts:
            if count != part.shape[axis]:
                raise ValueError(f"{count} numbers for {part.shape[axis]} {('rows', 'columns')[axis]}")
            part[:] = combine(part, values[:, None] if axis == 0 else values[None])
        return image

    return apply


@dataclass(frozen=True)
class _Polar:
    """Places of an image relative to an optical center, in units of the distance to the farthest corner."""

    right: np.ndarray
    down: np.ndarray
    center: tuple[float, float]
    unit: float

    @staticmethod
    def of(center_x: float, center_y: float, shape: tuple[int, ...]) -> "_Polar":
        height, width = shape[:2]
        x, y = center_x * (width - 1), center_y * (height - 1)
        unit = max(float(np.hypot(max(x, width - 1 - x), max(y, height - 1 - y))), 1e-6)
        if not np.isfinite(unit):
            raise ValueError("center is not finite")
        right = ((np.arange(width) - x) / unit).astype(np.float32)[None]
        return _Polar(right, ((np.arange(height) - y) / unit).astype(np.float32)[:, None], (x, y), unit)

    @property
    def squared(self) -> np.ndarray:
        """[H, W] squares of the distances from the center."""
        return self.right**2 + self.down**2


def _fix_vignette_radial(reader: _Reader, image: np.ndarray) -> np.ndarray:
    terms = reader.array("f8", 5)
    squared = _Polar.of(*reader.take("2d"), image.shape).squared  # pyright: ignore[reportCallIssue]
    image *= np.polynomial.polynomial.polyval(squared, [1.0, *terms]).astype(np.float32)[..., None]
    return image


def _warp_rectilinear(reader: _Reader, image: np.ndarray) -> np.ndarray:
    (planes,) = reader.take("I")
    terms = reader.array("f8", 6 * planes).reshape(-1, 6)
    polar = _Polar.of(*reader.take("2d"), image.shape)  # pyright: ignore[reportCallIssue]

    def moved(k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _bent(polar, np.polynomial.polynomial.polyval(polar.squared, k[:4]), k[4:])

    return _warp(image, polar, terms, moved)


def _warp_rectilinear_2(reader: _Reader, image: np.ndarray) -> np.ndarray:
    """Move pixels by a polynomial of the radius itself, within a range of radii, or by its reciprocal (DNG 1.6)."""
    (planes,) = reader.take("I")
    terms = reader.array("f8", 19 * planes).reshape(-1, 19)
    polar = _Polar.of(*reader.take("2d"), image.shape)  # pyright: ignore[reportArgumentType, reportCallIssue]
    (reciprocal,) = reader.take("I")

    def moved(k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        radius = np.sqrt(np.clip(polar.squared, k[17] ** 2, k[18] ** 2))
        factor = np.polynomial.polynomial.polyval(radius, k[:15])
        if reciprocal and not np.abs(factor).min() > 0:
            raise ValueError("a polynomial of 0")
        return _bent(polar, 1 / factor if reciprocal else factor, k[15:17])

    return _warp(image, polar, terms, moved)


def _bent(polar: _Polar, factor: np.ndarray, tangential: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return [H, W] places to the right and down: multiplied by a factor and moved by two tangential coefficients."""
    squared, right, down = polar.squared, polar.right, polar.down
    x = factor * right + tangential[0] * 2 * right * down + tangential[1] * (squared + 2 * right**2)
    y = factor * down + tangential[1] * 2 * right * down + tangential[0] * (squared + 2 * down**2)
    return x, y


def _warp_fisheye(reader: _Reader, image: np.ndarray) -> np.ndarray:
    (planes,) = reader.take("I")
    terms = reader.array("f8", 4 * planes).reshape(-1, 4)
    polar = _Polar.of(*reader.take("2d"), image.shape)  # pyright: ignore[reportCallIssue]

    def moved(k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        radius = np.sqrt(polar.squared)
        angle = np.arctan(radius)
        factor = angle * np.polynomial.polynomial.polyval(angle**2, k) / np.maximum(radius, 1e-9)
        return factor * polar.right, factor * polar.down

    return _warp(image, polar, terms, moved)


def _warp(image: np.ndarray, polar: _Polar, terms: np.ndarray, moved: Callable) -> np.ndarray:
    """Return each plane [H, W] resampled at moved(terms of the plane), relative to the center."""
    from scipy.ndimage import map_coordinates

    if not len(terms) or not np.isfinite(terms).all():
        raise ValueError("no finite terms")
    result = np.empty_like(image)
    for plane in range(image.shape[2]):
        if plane < len(terms):
            x, y = moved(terms[plane])
            places = np.stack([y * polar.unit + polar.center[1], x * polar.unit + polar.center[0]])
        map_coordinates(image[..., plane], places, order=1, mode="nearest", output=result[..., plane])
    return result


_FUNCTIONS: dict[int, Callable[[_Reader, np.ndarray], np.ndarray]] = {
    1: _warp_rectilinear, 2: _warp_fisheye, 3: _fix_vignette_radial, 4: _fix_bad_pixels_constant,
    5: _fix_bad_pixels_list, 7: _map_table, 8: _map_polynomial, 9: _gain_map, 10: _along(0, np.add),
    11: _along(1, np.add), 12: _along(0, np.multiply), 13: _along(1, np.multiply), 14: _warp_rectilinear_2,
}  # fmt: skip
