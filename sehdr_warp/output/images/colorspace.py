"""Linear color spaces of the output, by colour-science: from the package's linear Rec.709 by a 3 x 3 matrix."""

from functools import cache
from typing import NamedTuple

import numpy as np

from ...errors import SehdrError
from ...scene.color.primaries import REC709


class ColorSpace(NamedTuple):
    """A linear RGB space."""

    name: str  # On the command line
    dataset: str  # Key in colour.RGB_COLOURSPACES
    interop_id: str | None  # `colorInteropID` of OpenEXR (Color Interop Forum), if the space has one


SPACES = (
    ColorSpace("rec709", "ITU-R BT.709", "lin_rec709_scene"),
    ColorSpace("acescg", "ACEScg", "lin_ap1_scene"),
    ColorSpace("aces2065-1", "ACES2065-1", "lin_ap0_scene"),
    ColorSpace("rec2020", "ITU-R BT.2020", "lin_rec2020_scene"),
    ColorSpace("display-p3", "Display P3", "lin_p3d65_scene"),
    ColorSpace("dci-p3", "DCI-P3", None),
)
_ALIASES = {
    "bt709": "rec709", "bt2020": "rec2020",
    "ap1": "acescg", "ap0": "aces2065-1", "p3-d65": "display-p3",
}  # fmt: skip


def color_space(name: str) -> ColorSpace:
    """Return the space of a name or alias (`ap0`, `ap1`, `bt709`, `bt2020`, ...), in any case.

    Raises:
        SehdrError: For an unknown name.
    """
    key = str(name).strip().lower()
    if key == "srgb":
        raise SehdrError("color space 'srgb' is an encoding, and files hold linear light; rec709 has its primaries")
    for space in SPACES:
        if space.name == _ALIASES.get(key, key):
            return space
    raise SehdrError(f"color space {name!r} is not known; choose one of {', '.join(space.name for space in SPACES)}")


@cache
def chromaticities(name: str) -> tuple[float, ...]:
    """Return CIE xy of red, green, blue and white: eight numbers in the order of OpenEXR's `chromaticities`."""
    if color_space(name).name == "rec709":
        return REC709
    space = _dataset(color_space(name).dataset)
    return tuple(map(float, (*space.primaries.ravel(), *space.whitepoint)))


@cache
def matrix_to(dataset: str) -> np.ndarray:
    """Return [3, 3] float64 that converts linear Rec.709 column vectors to a space of colour.RGB_COLOURSPACES.

    White maps to white by Bradford's adaptation, as in the ACES transforms and OpenColorIO's built-in ones.
    """
    import colour

    return colour.matrix_RGB_to_RGB(_dataset(color_space("rec709").dataset), _dataset(dataset), "Bradford")


def from_rec709(rgb: np.ndarray, name: str) -> np.ndarray:
    """Convert [..., 3] linear Rec.709 to the named space, in float64. Values are not clipped."""
    rgb = np.asarray(rgb, np.float64)
    # A product with the identity would turn infinities into NaN and -0 into 0; Rec.709 passes through untouched.
    return rgb if color_space(name).name == "rec709" else rgb @ matrix_to(color_space(name).dataset).T


def _dataset(dataset: str):
    """Return colour-science's space with matrices derived from its primaries; the published ones are rounded."""
    import colour

    space = colour.RGB_COLOURSPACES[dataset].copy()
    space.use_derived_transformation_matrices(True)
    return space
