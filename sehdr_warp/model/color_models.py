"""Color models: spherical harmonics as log exposure, exposure, or encoded values; and colors of sensors.

Colors are exposures x = E dt_1 at the field's base time (c^{l_1} in the paper), so that their size, and with it the
learning rates, does not depend on the unit of time.
"""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import hardtanh

from ..response import Response

EXPOSURE_FLOOR = 1e-6  # Smallest exposure of the linear model, so that logs are finite; 0.01 of 8-bit black in sRGB
LOG_EXPOSURE_LIMIT = 40.0  # Largest absolute log exposure; exp of it stays finite in float32, squared and summed
CODE_RANGE = 1 / 255, 250 / 255  # Start colors are clipped to these encoded values; outside, photos state only a bound
# Fractions of the white level between which a channel's value blends from its own to the clipped estimate.
_CLIPPED = 0.75, 0.95


class ColorModel:
    """The log model: x = exp(SH(d)), always positive.

    Attributes:
        name: Name in config.model.radiance.
        display_referred: True if a color is an encoded value, which has no exposure until it is decoded.
    """

    name = "log"
    display_referred = False

    def start(self, encoded: np.ndarray, response: Response) -> np.ndarray:
        """Return [N, 3] start values of the harmonics' constant part from encoded values [N, 3] in [0, 1]."""
        return np.log(response.start_exposures(_clip_to_codes(encoded)))

    def brighten(self, value: Tensor, logarithm: Tensor) -> Tensor:
        """Return values [N, 3] whose exposures are exp(logarithm) times those of `value`."""
        return value + logarithm

    def colors(self, value: Tensor) -> Tensor:
        """Return the colors [N, 3] to blend, given the sums of the harmonics [N, 3]."""
        return self.logarithms(value, value).exp()

    def logarithms(self, value: Tensor, color: Tensor) -> Tensor:
        """Return the logarithms [N, 3] of the colors that colors() returned for the sums `value`."""
        # clamp(), but for the derivative, which is one operation in place of four.
        return hardtanh(value, -LOG_EXPOSURE_LIMIT, LOG_EXPOSURE_LIMIT)


class LinearModel(ColorModel):
    """The linear model: x = SH(d), kept positive (SeHDR)."""

    name = "linear"

    def start(self, encoded, response):
        """Return exposures of encoded values [N, 3], as in ColorModel."""
        return response.start_exposures(_clip_to_codes(encoded))

    def brighten(self, value, logarithm):
        """Return exposures, multiplied."""
        return value * logarithm.exp()

    def colors(self, value):
        """Return exposures, clamped from below to EXPOSURE_FLOOR."""
        return value.clamp_min(EXPOSURE_FLOOR)

    def logarithms(self, value, color):
        """Return the logarithm of the colors."""
        return color.log()


class DisplayModel(ColorModel):
    """The display model: encoded = max(SH(d) + 0.5, 0) (3DGS)."""

    name = "display"
    display_referred = True

    def start(self, encoded, response):
        """Return encoded values [N, 3] without the offset of 0.5."""
        return _clip_to_codes(encoded) - 0.5

    def colors(self, value):
        """Return encoded values, with an offset of 0.5, not below 0."""
        return value.add(0.5).clamp_min(0)


def make_color_model(name: str) -> ColorModel:
    """Return the model that config.model.radiance names."""
    return {kind.name: kind for kind in (ColorModel, LinearModel, DisplayModel)}[name]()


def _clip_to_codes(encoded: np.ndarray) -> np.ndarray:
    """Clip encoded values to the range in which a photo states a color."""
    return np.clip(np.asarray(encoded, dtype=np.float64), *CODE_RANGE)


def rec709_of(radiance: Tensor, matrix: np.ndarray | None, white: float) -> Tensor:
    """Convert radiance in the RGB of the photos, such as a sensor's or a clip's own, to linear Rec.709.

    All channels of a sensor clip at the same value, so a pixel clipped in all of them would turn magenta by white
    balance alone. A channel near its white level therefore counts as at least as bright as the brightest of the three
    after white balance. Colors outside the Rec.709 gamut have negative components, which are set to 0.

    Args:
        radiance: [..., 3] RGB of the photos.
        matrix: [3, 3] from that RGB to linear Rec.709, white balance included; None if it is linear Rec.709 already.
        white: Radiance at which a channel clips at base exposure: Response.white / base_time.

    Returns:
        [..., 3] linear Rec.709, >= 0; without a matrix, the radiance itself.
    """
    if matrix is None:
        return radiance
    to_rec709 = torch.tensor(matrix, dtype=radiance.dtype, device=radiance.device)
    neutral = torch.linalg.solve(to_rec709, torch.ones_like(to_rec709[0]))
    neutral = neutral / neutral.max()
    exposure = radiance / white
    low, high = _CLIPPED
    clipped = ((exposure - low) / (high - low)).clamp(0, 1)
    clipped = clipped * clipped * (3 - 2 * clipped)
    balanced = exposure / neutral
    balanced = balanced + clipped * (balanced.amax(dim=-1, keepdim=True) - balanced)
    return ((balanced * neutral * white) @ to_rec709.T).clamp_min(0)
