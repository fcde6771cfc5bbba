"""Tables of ICC profiles (`mft1`, `mft2`, `mAB `; ICC.1:2022, 10.10 to 10.12), evaluated in floating point.

LittleCMS through Pillow converts color of 8 bits only, limited to the gamut of the target. Scanners and converters
write 16 bits with such profiles, so their tables are read here. colour-science interpolates between their entries by
tetrahedra, as LittleCMS does.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

_D50 = np.array([0.9642, 1.0, 0.8249])  # White of the profile connection space, ICC.1:2022, 7.2.16
_MOST_ENTRIES = 1 << 22  # Of a table, 128 to each side and three channels are 6 million numbers
_EPSILON, _KAPPA = 216 / 24389, 24389 / 27
_ReadCurve = Callable[[bytes], np.ndarray]


@dataclass(frozen=True, eq=False)
class IccTable:
    """The way from a device's codes to the profile connection space. Stages that a profile lacks are None.

    Attributes:
        device_curves: samples of a curve for each channel, even in codes from 0 to 1.
        entries: [r, g, b, 3] values of the table.
        middle_curves: applied to what the table returns.
        matrix: [3, 4] factors and offsets, applied after these.
        output_curves: applied last.
        space: "XYZ", "Lab", or "Lab 16" for the older encoding of CIELAB in 16 bits.
    """

    device_curves: tuple[np.ndarray, ...] | None
    entries: np.ndarray | None
    middle_curves: tuple[np.ndarray, ...] | None
    matrix: np.ndarray | None
    output_curves: tuple[np.ndarray, ...] | None
    space: str

    def to_xyz(self, codes: np.ndarray) -> np.ndarray:
        """Return CIE XYZ relative to D50 [..., 3], Y 1 at the medium's white, of codes [..., 3] in [0, 1]."""
        values = _through(self.device_curves, codes)
        if self.entries is not None:
            from colour.algebra import table_interpolation_tetrahedral

            values = np.asarray(table_interpolation_tetrahedral(values, self.entries))
        values = _through(self.middle_curves, values)
        if self.matrix is not None:
            values = values @ self.matrix[:, :3].T + self.matrix[:, 3]
        values = _through(self.output_curves, values)
        if self.space == "XYZ":
            return values * (65535 / 32768)
        scale = 65535 / 65280 if self.space == "Lab 16" else 1.0
        lightness, a, b = np.moveaxis(values * scale * [100, 255, 255] - [0, 128, 128], -1, 0)
        y = (lightness + 16) / 116
        cubes = np.stack([y + a / 500, y, y - b / 200], axis=-1)
        return _D50 * np.where(cubes**3 > _EPSILON, cubes**3, (116 * cubes - 16) / _KAPPA)


def read_table(tag: bytes, space: str, read_curve: _ReadCurve) -> IccTable:
    """Read a profile's A2B tag of three channels.

    Args:
        tag: the tag's bytes.
        space: the profile connection space, "XYZ" or "Lab".
        read_curve: returns samples of a `curv` or `para` tag.

    Raises:
        ValueError, struct.error: if it is damaged, or of other than three channels.
    """
    if space not in ("XYZ", "Lab") or tag[8:10] != b"\3\3":
        raise ValueError
    if tag[:4] in (b"mft1", b"mft2"):
        return _of_lut(tag, space)
    if tag[:4] == b"mAB ":
        return _of_stages(tag, space, read_curve)
    raise ValueError


def _of_lut(tag: bytes, space: str) -> IccTable:
    """Read `mft1` (8 bits) or `mft2` (16 bits)."""
    grid = tag[10]
    deep = tag[:4] == b"mft2"
    count_in, count_out, at = (*struct.unpack_from(">HH", tag, 48), 52) if deep else (256, 256, 48)
    if not (grid >= 2 and grid**3 <= _MOST_ENTRIES and 2 <= count_in <= 4096 and 2 <= count_out <= 4096):
        raise ValueError
    numbers = np.frombuffer(tag, ">u2" if deep else "u1", 3 * (count_in + grid**3 + count_out), at)
    values = numbers / (65535 if deep else 255)
    first, table, last = np.split(values, [3 * count_in, 3 * (count_in + grid**3)])
    space_name = "Lab 16" if space == "Lab" and deep else space
    entries = table.reshape(grid, grid, grid, 3)
    return IccTable(tuple(first.reshape(3, -1)), entries, None, None, tuple(last.reshape(3, -1)), space_name)


def _of_stages(tag: bytes, space: str, read_curve: _ReadCurve) -> IccTable:
    """Read `mAB `: curves, table, curves, matrix, curves; places of 0 stand for stages that are missing."""
    output, matrix, middle, table, device = struct.unpack_from(">5I", tag, 12)

    def curves(at: int) -> tuple[np.ndarray, ...] | None:
        curves_of_stage = []
        for _ in range(3 if at else 0):
            curves_of_stage.append(read_curve(tag[at:]))
            at += -(-_curve_size(tag, at) // 4) * 4
        return tuple(curves_of_stage) or None

    entries = None
    if table:
        grid, wide = tuple(tag[table : table + 3]), tag[table + 16] == 2
        count = 3 * int(np.prod(grid))
        if len(grid) != 3 or min(grid) < 2 or count > 3 * _MOST_ENTRIES or tag[table + 16] not in (1, 2):
            raise ValueError
        numbers = np.frombuffer(tag, ">u2" if wide else "u1", count, table + 20)
        entries = (numbers / (65535 if wide else 255)).reshape(*grid, 3)
    factors = None
    if matrix:
        values = np.array(struct.unpack_from(">12i", tag, matrix)) / 65536
        factors = np.c_[values[:9].reshape(3, 3), values[9:]]
    return IccTable(curves(device) if table else None, entries, curves(middle), factors, curves(output), space)


def _curve_size(tag: bytes, at: int) -> int:
    """Return the bytes of a `curv` or `para` element."""
    if tag[at : at + 4] == b"para":
        return 12 + 4 * (1, 3, 4, 5, 7)[struct.unpack_from(">H", tag, at + 8)[0]]
    return 12 + 2 * struct.unpack_from(">I", tag, at + 8)[0]


def _through(curves: tuple[np.ndarray, ...] | None, values: np.ndarray) -> np.ndarray:
    """Return values [..., 3], each channel through its curve; values outside of 0 to 1 are clipped."""
    if curves is None:
        return values
    samples = (np.linspace(0, 1, len(curve)) for curve in curves)
    parts = [np.interp(values[..., i], x, y) for i, (x, y) in enumerate(zip(samples, curves, strict=True))]
    return np.stack(parts, axis=-1)
