"""Primaries and standard curves: linear Rec.709 from what files state, by colour-science."""

from dataclasses import dataclass
from functools import cache

import numpy as np

# ITU-R BT.709-6: red, green, blue and white, CIE xy. It needs no colour-science, which takes seconds to load.
REC709 = (0.640, 0.330, 0.300, 0.600, 0.150, 0.060, 0.3127, 0.3290)


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Decode sRGB (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(light: np.ndarray) -> np.ndarray:
    """Encode light as sRGB (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)


@cache
def matrix_to_rec709(chromaticities: tuple[float, ...]) -> np.ndarray:
    """Return [3, 3] to linear Rec.709, white to white by Bradford's adaptation.

    Args:
        chromaticities: CIE xy of red, green, blue and white, as in OpenEXR's attribute.

    Raises:
        ValueError: if they span no colors.
    """
    values = np.array(chromaticities, float)
    if np.allclose(values, REC709, atol=2e-4):
        return np.eye(3)
    corners = np.c_[values[:6].reshape(3, 2), np.ones(3)]
    if values.shape != (8,) or not np.isfinite(values).all() or abs(np.linalg.det(corners)) < 1e-4 or values[7] < 1e-3:
        raise ValueError(f"chromaticities {np.round(values, 4).tolist()} span no colors")
    import colour

    space = colour.RGB_Colourspace("stated", values[:6].reshape(3, 2), values[6:])
    target = colour.RGB_COLOURSPACES["ITU-R BT.709"].copy()
    for each in (space, target):
        each.use_derived_transformation_matrices(True)
    matrix = np.asarray(colour.matrix_RGB_to_RGB(space, target, "Bradford"), float)
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e3:
        raise ValueError(f"chromaticities {np.round(values, 4).tolist()} span no colors")
    return matrix


@dataclass(frozen=True)
class InteropEncoding:
    """Colors that a colorInteropID of OpenEXR (Color Interop Forum) states."""

    chromaticities: tuple[float, ...] | None  # CIE xy of red, green, blue and white; None if the ID is not known
    curve: str = "lin"  # Of its values: "lin", "srgb", "g18", "g22" or "g24"

    def decode(self, values: np.ndarray) -> np.ndarray:
        """Return linear values."""
        if self.curve == "lin":
            return values
        if self.curve == "srgb":
            return srgb_to_linear(values).astype(np.float32)
        return (np.maximum(values, 0) ** (int(self.curve[1:]) / 10)).astype(np.float32)


@cache
def encoding_of_interop_id(name: str) -> InteropEncoding:
    """Return what a colorInteropID such as `lin_ap1_scene` or `g22_rec709_scene` states."""
    curve, _, space = name.partition("_")
    space = space.removesuffix("_scene").removesuffix("_display")
    if curve not in ("lin", "srgb", "g18", "g22", "g24") or not space:
        return InteropEncoding(None)
    if space == "ciexyzd65":
        return InteropEncoding((1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.3127, 0.3290), curve)
    import OpenEXR

    chromaticities = OpenEXR.colorInteropIDToChromaticities(f"lin_{space}_scene")
    return InteropEncoding(
        None if chromaticities is None else tuple(map(float, chromaticities)), curve if chromaticities else "lin"
    )
