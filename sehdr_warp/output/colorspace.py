"""Linear colour spaces of the output: from the package's linear Rec.709 by a 3 x 3 matrix."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from sehdr_warp.errors import SehdrError

# Bradford's cone responses (Lam 1985): the adaptation of the ACES transforms and of OpenColorIO's built-in ones.
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

_D65, _ACES_WHITE, _DCI_WHITE = (0.3127, 0.3290), (0.32168, 0.33767), (0.314, 0.351)
_P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060)


@dataclass(frozen=True)
class ColorSpace:
    """A linear, scene-referred RGB space.

    name: as on the command line. primaries, white: CIE xy of red, green, blue, and of white.
    interop_id: the Color Interop Forum's name for it, which OpenEXR stores as `colorInteropID`; None if it has none.
    """

    name: str
    primaries: tuple[float, ...]
    white: tuple[float, float]
    interop_id: str | None


_SPACES = {
    space.name: space
    for space in (
        # ITU-R BT.709-6, items 1.3 and 1.4.
        ColorSpace("rec709", (0.640, 0.330, 0.300, 0.600, 0.150, 0.060), _D65, "lin_rec709_scene"),
        # AP1 of S-2014-004 and AP0 of SMPTE ST 2065-1.
        ColorSpace("acescg", (0.713, 0.293, 0.165, 0.830, 0.128, 0.044), _ACES_WHITE, "lin_ap1_scene"),
        ColorSpace("aces2065-1", (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770), _ACES_WHITE, "lin_ap0_scene"),
        # ITU-R BT.2020-2, table 3.
        ColorSpace("rec2020", (0.708, 0.292, 0.170, 0.797, 0.131, 0.046), _D65, "lin_rec2020_scene"),
        # SMPTE RP 431-2, and its primaries with D65 (SMPTE EG 432-1).
        ColorSpace("display-p3", _P3, _D65, "lin_p3d65_scene"),
        ColorSpace("dci-p3", _P3, _DCI_WHITE, None),
    )
}
_ALIASES = {
    "bt709": "rec709",
    "srgb": "rec709",
    "ap1": "acescg",
    "ap0": "aces2065-1",
    "bt2020": "rec2020",
    "p3-d65": "display-p3",
}


def color_space(name: str) -> ColorSpace:
    """The space of a name or alias (`ap0`, `ap1`, `bt709`, `bt2020`, ...), in any case; SehdrError if unknown."""
    key = name.strip().lower()
    key = _ALIASES.get(key, key)
    if key not in _SPACES:
        raise SehdrError(f"colour space {name!r} is not known; choose one of {', '.join(_SPACES)}")
    return _SPACES[key]


@cache
def chromaticities(name: str) -> tuple[float, ...]:
    """CIE xy of red, green, blue and white: eight numbers in the order of OpenEXR's `chromaticities`."""
    space = color_space(name)
    return (*space.primaries, *space.white)


@cache
def matrix_from_rec709(name: str) -> np.ndarray:
    """[3, 3] float64: linear Rec.709 column vectors to the named space, white to white (Bradford adaptation)."""
    source, target = color_space("rec709"), color_space(name)
    cones = [_BRADFORD @ _xyz(*space.white) for space in (source, target)]
    adapt = np.linalg.solve(_BRADFORD, np.diag(cones[1] / cones[0]) @ _BRADFORD)
    matrix = np.linalg.solve(_to_xyz(target), adapt @ _to_xyz(source)) if source != target else np.eye(3)
    matrix.setflags(write=False)
    return matrix


def from_rec709(rgb: np.ndarray, name: str) -> np.ndarray:
    """Converts [..., 3] linear Rec.709 to the named space, in float64. Values are not clipped."""
    rgb = np.asarray(rgb, np.float64)
    # A product with the identity would turn infinities into NaN and -0 into 0; Rec.709 passes through untouched.
    return rgb if color_space(name).name == "rec709" else rgb @ matrix_from_rec709(name).T


def _to_xyz(space: ColorSpace) -> np.ndarray:
    """[3, 3] RGB column vectors to CIE XYZ, white at Y = 1 (SMPTE RP 177)."""
    primaries = np.stack([_xyz(*space.primaries[i : i + 2]) for i in (0, 2, 4)], axis=1)
    return primaries * np.linalg.solve(primaries, _xyz(*space.white))


def _xyz(x: float, y: float) -> np.ndarray:
    """XYZ of a chromaticity at Y = 1."""
    return np.array([x, y, 1 - x - y]) / y
