"""Camera responses that have a formula, evaluated with their derivative in one launch (kernels/response_curves.py)."""

from dataclasses import dataclass

import torch
import warp as wp

from ..kernels.geometry import vector
from ..kernels.response_curves import FILMIC, KNEE, NO_TONE, REINHARD, encode_kernel
from .arrays import view, warp_scalar
from .bridge import torch_stream

TONES = {"none": NO_TONE, "reinhard": REINHARD, "filmic": FILMIC, "knee": KNEE}


@dataclass(frozen=True)
class FormulaCurve:
    """power_law: exponent, offset, slope and end of the toe, as model.response_analytic's PowerLaw takes them; tone:
    the curve before it, a name in TONES, with its numbers; clip: the clip point, infinite for none."""

    power_law: tuple[float, float, float, float]
    tone: str = "none"
    tone_numbers: tuple[float, ...] = ()
    clip: float = 1.0


@torch.no_grad()
def encode_with_slope(
    exposure: torch.Tensor, curve: FormulaCurve, extension_slope: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The encoded values of exposures [...], float32 or float64, with extension_slope log(x / clip) added beyond the
    clip point, and their derivatives by exposure: 0 below 0, NaN for NaN."""
    exposure = exposure.contiguous()
    values, slopes = torch.empty_like(exposure), torch.empty_like(exposure)
    scalar = warp_scalar(exposure.dtype)
    numbers = (*curve.tone_numbers, *[0.0] * (5 - len(curve.tone_numbers)))
    if exposure.numel():
        with torch_stream(exposure.device):
            wp.launch(
                encode_kernel(scalar, TONES[curve.tone]),
                dim=exposure.numel(),
                inputs=[
                    view(exposure.view(-1)),
                    vector(4, scalar)(*curve.power_law),
                    vector(5, scalar)(*numbers),
                    curve.clip,
                    extension_slope,
                    view(values.view(-1)),
                    view(slopes.view(-1)),
                ],
                device=wp.device_from_torch(exposure.device),
                record_tape=False,
            )
    return values, slopes
