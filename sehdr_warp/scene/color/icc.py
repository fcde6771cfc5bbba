"""ICC profiles of photos: LittleCMS (through Pillow) checks them; matrix, curves and tables are read for 16 bits.

Pillow's transforms return 8 bits limited to the target's gamut, which would lose what a profile of a wide gamut states.
Scanners and converters write 16 bits with tables (`mft1`, `mft2`, `mAB `; ICC.1:2022, 10.10 to 10.12), which are
interpolated by tetrahedra here, as LittleCMS does.
"""

import io
import struct
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

_D50 = np.array([0.9642, 1.0, 0.8249])  # White of the profile connection space, ICC.1:2022, 7.2.16
_MOST_ENTRIES = 1 << 22  # Of a table, 128 to each side and three channels are 6 million numbers
_AT_ONCE = 1 << 14  # Colors that are converted at a time, whose floats stay in the caches of a processor
_EPSILON, _KAPPA = 216 / 24389, 24389 / 27
_MOST_BYTES = 16 << 20  # Above any profile in use; printer tables have a few megabytes
# Linear Rec.709 (sRGB, IEC 61966-2-1) from XYZ relative to D50, the connection space of ICC profiles.
_REC709_FROM_D50 = np.array([
    [3.1338561, -1.6168667, -0.4906146], [-0.9787684, 1.9161415, 0.0334540], [0.0719453, -0.2289914, 1.4052427],
])  # fmt: skip
_MOST_OF_NAME = 80  # Characters that lines show
_PARAMETERS = (1, 3, 4, 5, 7)  # Of a `para` curve by its kind
_SAMPLES = 65_536  # Of a curve that a formula describes: exact at all codes of 8 and 16 bits


@dataclass(frozen=True, eq=False)
class IccTable:
    """The way from a device's codes to the profile connection space. Stages that a profile lacks are None."""

    device_curves: tuple[np.ndarray, ...] | None  # Samples of a curve for each channel, even in codes from 0 to 1
    entries: np.ndarray | None  # [r, g, b, 3] values of the table
    middle_curves: tuple[np.ndarray, ...] | None  # Applied to what the table returns
    matrix: np.ndarray | None  # [3, 4] factors and offsets, applied after these
    output_curves: tuple[np.ndarray, ...] | None  # Applied last
    space: str  # "XYZ", "Lab", or "Lab 16" for the older encoding of CIELAB in 16 bits

    def to_xyz(self, codes: np.ndarray) -> np.ndarray:
        """Return CIE XYZ relative to D50 [..., 3], Y 1 at the medium's white, of codes [..., 3] in [0, 1]."""
        values = _through(self.device_curves, np.asarray(codes, np.float32))
        values = values if self.entries is None else _interpolate(self.entries, values)
        values = _through(self.middle_curves, values)
        if self.matrix is not None:
            values = values @ self.matrix[:, :3].T.astype(np.float32) + self.matrix[:, 3].astype(np.float32)
        values = _through(self.output_curves, values)
        if self.space == "XYZ":
            return values * np.float32(65535 / 32768)
        scale = 65535 / 65280 if self.space == "Lab 16" else 1.0
        # (L + 16) / 116 + (a / 500, 0, -b / 200) of CIELAB from values of 0 to 1
        to_cubes = np.array([[100 / 116] * 3, [255 / 500, 0, 0], [0, 0, -255 / 200]], np.float32) * np.float32(scale)
        offset = np.array([16 / 116 - 128 / 500, 16 / 116, 16 / 116 + 128 / 200], np.float32)
        roots = values @ to_cubes + offset
        cubes = roots * roots * roots
        light = np.where(cubes > _EPSILON, cubes, (116 * roots - 16) / np.float32(_KAPPA))
        return light * _D50.astype(np.float32)

    def light(self, pixels: np.ndarray) -> np.ndarray:
        """Return linear Rec.709 [H, W, 3] float32 of codes [H, W, 3] uint8 or uint16. Threads may call it together.

        A color of 8 bits is converted when a photo shows it first.
        """
        if pixels.dtype != np.uint8:
            return xyz_to_rec709(self.to_xyz(pixels / np.float32(65535))).astype(np.float32)
        known, colors = self._known_colors
        red, green, blue = (pixels[..., channel].astype(np.int32) for channel in range(3))
        numbers = red | green << 8 | blue << 16
        if len(new := np.unique(numbers[~known[numbers]])):
            for some in np.array_split(new, 1 + len(new) // _AT_ONCE):
                codes = np.stack([some & 255, some >> 8 & 255, some >> 16], axis=1)
                colors[some] = xyz_to_rec709(self.to_xyz(codes / np.float32(255)))
            known[new] = True  # After their light, which another thread may read now
        return colors[numbers]

    @cached_property
    def _known_colors(self) -> tuple[np.ndarray, np.ndarray]:
        # The system gives memory to pages that are written alone: photos show a small part of all colors.
        return np.zeros(1 << 24, bool), np.zeros((1 << 24, 3), np.float32)


@dataclass(frozen=True)
class IccProfile:
    """Colors that a profile states."""

    name: str  # Its description
    colors: str  # "RGB" or "GRAY"
    to_rec709: np.ndarray | None  # [3, 3] to linear Rec.709; None for grey
    curves: tuple[np.ndarray, ...]  # Decoded values at even codes from 0 to 1, by channel; empty for a table
    cicp: tuple[int, int] | None  # (primaries, transfer) of ITU-T H.273, if the profile states them
    table: IccTable | None = None  # The profile's table, which stands before matrix and curves; None if it has none


@lru_cache(maxsize=64)
def read_profile(data: bytes) -> IccProfile:
    """Read a profile as it is embedded in photos.

    Raises:
        ValueError: if it is damaged, of other colors than RGB or grey, or not usable; the message is for the user.
    """
    from PIL import ImageCms

    if len(data) > _MOST_BYTES:
        raise ValueError(f"has {len(data)} bytes")
    try:
        profile: Any = ImageCms.ImageCmsProfile(io.BytesIO(data)).profile
        name = " ".join((profile.profile_description or "").split())[:_MOST_OF_NAME] or "an unnamed profile"
        colors = profile.xcolor_space.strip()
    except (OSError, ImageCms.PyCMSError, ValueError, TypeError, AttributeError):
        raise ValueError("is damaged") from None
    if colors not in ("RGB", "GRAY"):
        raise ValueError(f"is of {colors}, not RGB")
    try:
        tags = _tags(data)
        cicp = (tags[b"cicp"][8], tags[b"cicp"][9]) if len(tags.get(b"cicp", b"")) >= 12 else None
        if colors == "GRAY":
            return IccProfile(name, colors, None, (_curve(tags[b"kTRC"]),) * 3, cicp)
        # Of the relative colorimetric intent, or of the only one, as LittleCMS takes it.
        if (table := tags.get(b"A2B1") or tags.get(b"A2B0")) is not None and cicp is None:
            space = profile.connection_space.strip()
            return IccProfile(name, colors, None, (), cicp, _read_table(table, space))
        curves = tuple(_curve(tags[tag]) for tag in (b"rTRC", b"gTRC", b"bTRC")) if b"rTRC" in tags else ()
        to_xyz = np.eye(3)
        if curves:
            columns = [struct.unpack_from(">3i", tags[tag], 8) for tag in (b"rXYZ", b"gXYZ", b"bXYZ")]
            to_xyz = np.stack(columns, axis=1) / 65536
    except (KeyError, struct.error, IndexError, ValueError, OverflowError):
        raise ValueError("is damaged") from None
    if not curves and cicp is None:
        raise ValueError("states no colors")
    matrix = _REC709_FROM_D50 @ to_xyz
    if curves and (not np.isfinite(matrix).all() or abs(np.linalg.det(to_xyz)) < 1e-4 or np.abs(matrix).max() > 100):
        raise ValueError("has primaries that span no colors")
    if any(not np.isfinite(curve).all() or np.ptp(curve) <= 0 or curve[-1] <= curve[0] for curve in curves):
        raise ValueError("has a curve that does not rise")
    return IccProfile(name, colors, matrix, curves, cicp)  # pyright: ignore[reportArgumentType]


def xyz_to_rec709(xyz: np.ndarray) -> np.ndarray:
    """Return linear Rec.709 [..., 3] of CIE XYZ relative to D50, the connection space of ICC profiles."""
    return xyz @ _REC709_FROM_D50.T


def _tags(data: bytes) -> dict[bytes, bytes]:
    (count,) = struct.unpack_from(">I", data, 128)
    if count > 1000:
        raise ValueError
    entries = (struct.unpack_from(">4sII", data, 132 + 12 * i) for i in range(count))
    return {tag: data[offset : offset + size] for tag, offset, size in entries}


def _curve(tag: bytes) -> np.ndarray:
    """Return a `curv` or `para` tag as samples (ICC.1:2022, 10.6 and 10.18)."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count > 1:
            return np.frombuffer(tag, ">u2", count, 12) / 65535
        gamma = struct.unpack_from(">H", tag, 12)[0] / 256 if count else 1.0
        if not gamma > 0:
            raise ValueError
        return np.linspace(0, 1, _SAMPLES) ** gamma
    if tag[:4] != b"para":
        raise ValueError
    kind = struct.unpack_from(">H", tag, 8)[0]
    count = _PARAMETERS[kind]
    g, a, b, c, d, e, f = np.pad(np.array(struct.unpack_from(f">{count}i", tag, 12)) / 65536, (0, 7 - count))
    if not g > 0 or (kind and a == 0):
        raise ValueError
    x = np.linspace(0, 1, _SAMPLES)
    if kind == 0:
        return x**g
    power = np.maximum(a * x + b, 0) ** g
    if kind == 1:
        return np.where(x >= -b / a, power, 0)
    if kind == 2:
        return np.where(x >= -b / a, power + c, c)
    return np.where(x >= d, power + (e if kind == 4 else 0), c * x + (f if kind == 4 else 0))


def _read_table(tag: bytes, space: str) -> IccTable:
    """Read a profile's A2B tag of three channels; `space` is the profile connection space, "XYZ" or "Lab".

    Raises:
        ValueError, struct.error: if it is damaged, or of other than three channels.
    """
    if space not in ("XYZ", "Lab") or tag[8:10] != b"\3\3":
        raise ValueError
    if tag[:4] in (b"mft1", b"mft2"):
        return _of_lut(tag, space)
    if tag[:4] == b"mAB ":
        return _of_stages(tag, space)
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


def _of_stages(tag: bytes, space: str) -> IccTable:
    """Read `mAB `: curves, table, curves, matrix, curves; places of 0 stand for stages that are missing."""
    output, matrix, middle, table, device = struct.unpack_from(">5I", tag, 12)

    def curves(at: int) -> tuple[np.ndarray, ...] | None:
        curves_of_stage = []
        for _ in range(3 if at else 0):
            curves_of_stage.append(_curve(tag[at:]))
            if tag[at : at + 4] == b"para":
                size = 12 + 4 * _PARAMETERS[struct.unpack_from(">H", tag, at + 8)[0]]
            else:
                size = 12 + 2 * struct.unpack_from(">I", tag, at + 8)[0]
            at += -(-size // 4) * 4
        return tuple(curves_of_stage) or None

    entries = factors = None
    if table:
        grid, wide = tuple(tag[table : table + 3]), tag[table + 16] == 2
        count = 3 * int(np.prod(grid))
        if len(grid) != 3 or min(grid) < 2 or count > 3 * _MOST_ENTRIES or tag[table + 16] not in (1, 2):
            raise ValueError
        numbers = np.frombuffer(tag, ">u2" if wide else "u1", count, table + 20)
        entries = (numbers / (65535 if wide else 255)).reshape(*grid, 3)
    if matrix:
        values = np.array(struct.unpack_from(">12i", tag, matrix)) / 65536
        factors = np.c_[values[:9].reshape(3, 3), values[9:]]
    return IccTable(curves(device) if table else None, entries, curves(middle), factors, curves(output), space)


def _through(curves: tuple[np.ndarray, ...] | None, values: np.ndarray) -> np.ndarray:
    """Return float32 values [..., 3], each channel through its curve; values outside of 0 to 1 are clipped."""
    if curves is None:
        return values
    result = np.empty_like(values)
    for channel, curve in enumerate(curves):
        # Samples are even, so that no search is needed, as numpy.interp's.
        samples = curve.astype(np.float32)
        first, part = _below(values[..., channel], len(samples))
        result[..., channel] = samples[first] + part * np.diff(samples)[first]
    return result


def _below(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the sample below each value in [0, 1], of `count` even ones, and the part of the way on."""
    places = np.clip(values, 0, 1) * np.float32(count - 1)
    first = np.minimum(places.astype(np.int32), count - 2)
    return first, places - first


def _interpolate(entries: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return entries [r, g, b, 3] at values [..., 3]: between corners of the tetrahedron that holds each value.

    From the cell's lowest corner the way goes along the axis of the largest part first, then of the middle one.
    """
    strides = np.array([entries.shape[1] * entries.shape[2], entries.shape[2], 1])
    axes = [_below(values[..., axis], entries.shape[axis]) for axis in range(3)]
    corner = sum(first * stride for (first, _), stride in zip(axes, strides, strict=True))
    (_, r), (_, g), (_, b) = axes
    largest, least = np.maximum(np.maximum(r, g), b), np.minimum(np.minimum(r, g), b)
    middle = r + g + b - largest - least
    along = np.where((r >= g) & (r >= b), strides[0], np.where(g >= b, strides[1], strides[2]))
    last = np.where((b <= r) & (b <= g), strides[2], np.where(g <= r, strides[1], strides[0]))
    table = entries.reshape(-1, 3).astype(np.float32)
    result = table[corner] * (1 - largest)[..., None]
    result += table[corner + along] * (largest - middle)[..., None]
    result += table[corner + (strides.sum() - last)] * (middle - least)[..., None]
    result += table[corner + strides.sum()] * least[..., None]
    return result
