"""Linear colour spaces of the output: from the package's linear Rec.709 by a 3 x 3 matrix."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from sehdr_warp.errors import SehdrError

# The adaptation of the ACES transforms (and of OpenColorIO's built-in ones), where white points differ.
CHROMATIC_ADAPTATION = "Bradford"

# ITU-R BT.709-6, items 1.3 and 1.4. Importing colour-science takes a second, which the default need not.
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


@dataclass(frozen=True)
class ColorSpace:
    """A linear, scene-referred RGB space.

    name: as on the command line; title: as colour-science calls it.
    interop_id: the Color Interop Forum's name for it, which OpenEXR stores as `colorInteropID`; None if it has none.
    """

    name: str
    title: str
    interop_id: str | None


_SPACES = {
    space.name: space
    for space in (
        ColorSpace("rec709", "ITU-R BT.709", "lin_rec709_scene"),
        ColorSpace("acescg", "ACEScg", "lin_ap1_scene"),
        ColorSpace("aces2065-1", "ACES2065-1", "lin_ap0_scene"),
        ColorSpace("rec2020", "ITU-R BT.2020", "lin_rec2020_scene"),
        ColorSpace("display-p3", "Display P3", "lin_p3d65_scene"),
        ColorSpace("dci-p3", "DCI-P3", None),
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


def color_space_names() -> list[str]:
    """The names that color_space takes, without aliases."""
    return list(_SPACES)


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
    if color_space(name).name == "rec709":
        return _REC709
    space = _colourspace(name)
    return tuple(float(value) for value in (*space.primaries.ravel(), *space.whitepoint))


@cache
def matrix_from_rec709(name: str) -> np.ndarray:
    """[3, 3] float64: linear Rec.709 column vectors to the named space, white to white (Bradford adaptation)."""
    if color_space(name).name == "rec709":
        matrix = np.eye(3)
    else:
        import colour

        matrix = colour.matrix_RGB_to_RGB(_colourspace("rec709"), _colourspace(name), CHROMATIC_ADAPTATION)
    matrix.setflags(write=False)
    return matrix


def from_rec709(rgb: np.ndarray, name: str) -> np.ndarray:
    """Converts [..., 3] linear Rec.709 to the named space, in float64. Values are not clipped."""
    rgb = np.asarray(rgb, np.float64)
    # A product with the identity would turn infinities into NaN and -0 into 0; Rec.709 passes through untouched.
    return rgb if color_space(name).name == "rec709" else rgb @ matrix_from_rec709(name).T


def _colourspace(name: str):
    import colour

    return colour.RGB_COLOURSPACES[color_space(name).title]
