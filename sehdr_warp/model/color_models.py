"""Color models: spherical harmonics as log exposure, exposure, or encoded values.

Colors are exposures x = E dt_1 at the field's base time (c^{l_1} in the paper), so that their size, and with it the
learning rates, does not depend on the unit of time.
"""

import numpy as np
from torch import Tensor
from torch.nn.functional import hardtanh

from ..rasterizer.activations import bounded_exponential
from ..response import Response

EXPOSURE_FLOOR = (
    1e-6  # Smallest exposure of the linear model; keeps logarithms finite, 100 times below 8-bit black in sRGB
)
LOG_EXPOSURE_LIMIT = 40.0  # Largest absolute log exposure; exp of it stays finite in float32, squared and summed
CODE_RANGE = (
    1 / 255,
    250 / 255,
)  # Encoded values of start colors are clipped to this: outside, a photo states only a bound


class ColorModel:
    """The log model: x = exp(SH(d)), always positive.

    Attributes:
        name: Name in config.model.radiance.
        encoded: True if a color is an encoded value, which has no exposure until it is decoded.
    """

    name = "log"
    encoded = False

    def start(self, encoded: np.ndarray, response: Response) -> np.ndarray:
        """Return [N, 3] start values of the harmonics' constant part from encoded values [N, 3] in [0, 1]."""
        return np.log(response.start_exposures(_clip_to_codes(encoded)))

    def colors(self, value: Tensor) -> Tensor:
        """Return the colors [N, 3] to blend, given the sums of the harmonics [N, 3]."""
        return bounded_exponential(value, LOG_EXPOSURE_LIMIT)

    def logarithms(self, value: Tensor, color: Tensor) -> Tensor:
        """Return the logarithms [N, 3] of the colors that colors() returned for the sums `value`."""
        return hardtanh(value, -LOG_EXPOSURE_LIMIT, LOG_EXPOSURE_LIMIT)


class LinearModel(ColorModel):
    """The linear model: x = SH(d), kept positive (SeHDR)."""

    name = "linear"

    def start(self, encoded, response):
        """Return exposures of encoded values [N, 3], as in ColorModel."""
        return response.start_exposures(_clip_to_codes(encoded))

    def colors(self, value):
        """Return exposures, clamped from below to EXPOSURE_FLOOR."""
        return value.clamp_min(EXPOSURE_FLOOR)

    def logarithms(self, value, color):
        """Return the logarithm of the colors."""
        return color.log()


class DisplayModel(ColorModel):
    """The display model: encoded = max(SH(d) + 0.5, 0) (3DGS)."""

    name = "display"
    encoded = True

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
