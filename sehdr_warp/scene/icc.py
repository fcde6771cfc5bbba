"""ICC profiles of photos: LittleCMS (through Pillow) checks them; matrix, curves and tables are read for 16 bits.

Pillow's transforms return 8 bits limited to the target's gamut, which would lose what a profile of a wide gamut states.
"""

import io
import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from .icc_table import IccTable, read_table

_MOST_BYTES = 16 << 20  # Above any profile in use; printer tables have a few megabytes
# Linear Rec.709 (sRGB, IEC 61966-2-1) from XYZ relative to D50, the connection space of ICC profiles.
_REC709_FROM_D50 = np.array(
    [
        [3.1338561, -1.6168667, -0.4906146],
        [-0.9787684, 1.9161415, 0.0334540],
        [0.0719453, -0.2289914, 1.4052427],
    ]
)
_MOST_OF_NAME = 80  # Characters that lines show
_SAMPLES = 65_536  # Of a curve that a formula describes: exact at all codes of 8 and 16 bits


@dataclass(frozen=True)
class IccProfile:
    """Colors that a profile states.

    Attributes:
        name: its description.
        colors: "RGB" or "GRAY".
        to_rec709: [3, 3] to linear Rec.709; None for grey.
        curves: decoded values at evenly spaced codes from 0 to 1, one array for each channel; empty if the profile is
            a table.
        cicp: (primaries, transfer) of ITU-T H.273, if the profile states them.
        table: the profile's table, which stands before matrix and curves; None if it has none.
    """

    name: str
    colors: str
    to_rec709: np.ndarray | None
    curves: tuple[np.ndarray, ...]
    cicp: tuple[int, int] | None
    table: IccTable | None = None


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
            return IccProfile(name, colors, None, (), cicp, read_table(table, space, _curve))
        curves = tuple(_curve(tags[tag]) for tag in (b"rTRC", b"gTRC", b"bTRC")) if b"rTRC" in tags else ()
        to_xyz = np.stack([_xyz(tags[tag]) for tag in (b"rXYZ", b"gXYZ", b"bXYZ")], axis=1) if curves else np.eye(3)
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


def _xyz(tag: bytes) -> np.ndarray:
    return np.array(struct.unpack_from(">3i", tag, 8)) / 65536


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
    count = (1, 3, 4, 5, 7)[kind]
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
