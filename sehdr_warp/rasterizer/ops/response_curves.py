"""Camera responses that have a formula, evaluated with their derivative in one launch (kernels/response_curves.py)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ...kernels.geometry import vector
from ...kernels.response_curves import FILMIC, KNEE, NO_TONE, REINHARD, encode_kernel
from ..warp_launch.launching import launch, warp_scalar

TONES = {"none": NO_TONE, "reinhard": REINHARD, "filmic": FILMIC, "knee": KNEE}


@dataclass(frozen=True)
class FormulaCurve:
    """A camera response that has a formula."""

    power_law: tuple[float, float, float, float]  # Exponent, offset, slope and end of the toe, as of PowerLaw
    tone: str = "none"  # The curve before it, a name in TONES
    tone_numbers: tuple[float, ...] = ()  # Of the tone curve
    clip: float = 1.0  # The clip point, infinite for none


@torch.no_grad()
def encode_with_slope(exposure: Tensor, curve: FormulaCurve, extension_slope: float) -> tuple[Tensor, Tensor]:
    """Return the encoded values of exposures [...] and their derivatives: 0 below 0, NaN for NaN.

    Beyond the clip point extension_slope * log(x / clip) is added. float32 or float64.
    """
    exposure = exposure.contiguous()
    values, slopes = torch.empty_like(exposure), torch.empty_like(exposure)
    scalar = warp_scalar(exposure.dtype)
    numbers = (*curve.tone_numbers, *[0.0] * (5 - len(curve.tone_numbers)))
    constants = vector(4, scalar)(*curve.power_law), vector(5, scalar)(*numbers), curve.clip, extension_slope
    launch(encode_kernel(scalar, TONES[curve.tone]), exposure.numel(), exposure, *constants, values, slopes)
    return values, slopes
