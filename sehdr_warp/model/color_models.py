"""What a Gaussian's harmonics mean: log exposure, exposure, or encoded values.

Colors are exposures x = E dt_1 at the field's base time (the paper's c^{l_1}), so that their size, and with it the
learning rates, does not depend on the unit of time.
"""

import numpy as np
from torch import Tensor
from torch.nn.functional import hardtanh

from ..rasterizer.activations import bounded_exponential
from ..response import Response

EXPOSURE_FLOOR = 1e-6  # Of the linear model: keeps logarithms finite, 100 times below 8-bit black in sRGB
LOG_EXPOSURE_LIMIT = 40.0  # Either way: exp stays finite in float32, even squared and summed over a pixel
CODE_RANGE = (1 / 255, 250 / 255)  # Of start colors, encoded: beyond it a photo tells a bound, not a color


class ColorModel:
    """The log model: x = exp(SH(d)), always positive."""

    name = "log"
    encoded = False
    """Whether a color is an encoded value, which has no exposure until it is decoded."""

    def start(self, encoded: np.ndarray, response: Response) -> np.ndarray:
        """[N, 3] start values of the harmonics' constant part from encoded values [N, 3] in [0, 1]."""
        return np.log(response.start_exposures(_within(encoded)))

    def colors(self, value: Tensor) -> Tensor:
        """What is blended, from the harmonics' sum, [N, 3] each."""
        return bounded_exponential(value, LOG_EXPOSURE_LIMIT)

    def logarithms(self, value: Tensor, color: Tensor) -> Tensor:
        """Of the colors that colors() made of the values, [N, 3] each."""
        return hardtanh(value, -LOG_EXPOSURE_LIMIT, LOG_EXPOSURE_LIMIT)


class LinearModel(ColorModel):
    """x = SH(d), kept positive (SeHDR)."""

    name = "linear"

    def start(self, encoded, response):
        return response.start_exposures(_within(encoded))

    def colors(self, value):
        return value.clamp_min(EXPOSURE_FLOOR)

    def logarithms(self, value, color):
        return color.log()


class DisplayModel(ColorModel):
    """encoded = max(SH(d) + 0.5, 0) (3DGS)."""

    name = "display"
    encoded = True

    def start(self, encoded, response):
        return _within(encoded) - 0.5

    def colors(self, value):
        return value.add(0.5).clamp_min(0)


def color_model(name: str) -> ColorModel:
    """The model that config.model.radiance names."""
    return {kind.name: kind for kind in (ColorModel, LinearModel, DisplayModel)}[name]()


def _within(encoded: np.ndarray) -> np.ndarray:
    return np.clip(np.asarray(encoded, dtype=np.float64), *CODE_RANGE)
