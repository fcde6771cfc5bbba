"""Confidence in a scene's light, per Gaussian, from the pixels that it contributes to in the training views.

The sum over a photo's pixels of (blending weight of a Gaussian) x (value of the pixel) is the derivative of the blended
image with respect to that Gaussian's feature, so one backward pass per view gathers it for all Gaussians. The value is
the uncertainty of the pixel's light in stops; see pixel_uncertainty.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..progress import track_progress
from ..response import Response
from ..response.curve import HALF_CODE
from ..scene import View
from .radiance_field import RadianceField
from .residual_regions import MAX_VIEWS, high_residual_mask
from .visibility import blending_weights

log = logging.getLogger(__name__)

CLIPPED_STOPS = 1.0  # Uncertainty of a pixel that is clipped in all channels and has no estimate, stops
PARTLY_CLIPPED_STOPS = 0.25  # Uncertainty of a clipped channel beside unclipped ones, stops
MAX_STOPS = 4.0  # Largest misfit that counts; a confidence of 1/16 already means unknown
HALF_CONFIDENCE_PIXELS = 0.01  # Sum of blending weights over all photos, in pixels, at which the confidence is halved
MIN_CONTRIBUTION = 1 / 255  # Blending weight in one photo, pixels; a Gaussian with less is not part of the scene
RESIDUAL_WEIGHT = 8.0  # Weight of pixels that the scene does not reproduce: what they hide is seen in other photos


@dataclass(frozen=True)
class Evidence:
    """Evidence of the training photos for N Gaussians; tensors [N]."""

    # Sum of blending weights over pixels, times RESIDUAL_WEIGHT where the scene does not reproduce them
    weight_sum: Tensor
    stops: Tensor  # Mean uncertainty in stops
    clipped: Tensor  # Fraction of clipped values
    peak: Tensor  # Sum of blending weights, as in weight_sum, in the photo in which it is largest
    clipped_stops: Tensor  # Part of `stops` that is of clipped values; divided by `clipped`, their mean uncertainty

    @property
    def contributes(self) -> Tensor:
        """Mask [N] of the Gaussians that change any photo by more than an 8-bit code, summed over its pixels."""
        return self.peak > MIN_CONTRIBUTION

    def rows(self, index: Tensor) -> "Evidence":
        """Return the evidence of the Gaussians at an index or mask [N]."""
        return Evidence(**{name: values[index] for name, values in vars(self).items()})

    def confidence(self) -> Tensor:
        """Return [N] in [0, 1]: 1 observed unclipped and reproduced, 1/2 known to a factor of two, 0 never seen."""
        return torch.exp2(-self.stops) * self.weight_sum / (self.weight_sum + HALF_CONFIDENCE_PIXELS)


def pixel_uncertainty(
    photo: Tensor, exposure: Tensor, response: Response, deviation: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the uncertainty of the light at a photo's pixels, in stops, their clipped fraction, and its uncertainty.

    The uncertainty is the mean over channels of

        unclipped channel   |log2(exposure / decoded value)|, the misfit, plus a quarter of the width of its 8-bit
                            code's interval in stops (the mean distance from its middle), at most 1
        clipped channel     the stops by which the exposure falls short of white, plus the deviation of the estimate of
                            its light; without an estimate CLIPPED_STOPS, or PARTLY_CLIPPED_STOPS beside unclipped
                            channels
        black channel       the stops by which the exposure is above half a code, plus 1

    Args:
        photo: [H, W, 3] encoded, in [0, 1].
        exposure: [H, W, 3] exposure E dt of the rendered scene.
        response: The camera response.
        deviation: [H, W, 3] stops, of estimates of clipped light; infinite where there is none.

    Returns:
        Three tensors [H, W]. The last one is the part of the first that is of clipped channels.
    """
    half_code = response.decode(photo.new_full((1, 3), HALF_CODE))
    white = response.white
    clipped, black = photo >= 1 - HALF_CODE, photo <= HALF_CODE
    # A photo does not distinguish exposures below half a code.
    lifted = torch.maximum(exposure, half_code)
    misfit = (lifted / torch.maximum(response.decode(photo), half_code)).log2().abs()
    misfit = torch.where(clipped, (white / lifted).log2().clamp_min(0), misfit)
    misfit = torch.where(black, (lifted / half_code).log2(), misfit).clamp_max(MAX_STOPS)
    low, high = (response.decode((photo + offset).clamp(0, 1)) for offset in (-HALF_CODE, HALF_CODE))
    rounding = ((high.clamp_min(1e-12) / low.clamp_min(1e-12)).log2() / 4).clamp(0, 1)
    unknown = torch.where(clipped.all(2, keepdim=True), CLIPPED_STOPS, PARTLY_CLIPPED_STOPS)
    if deviation is not None:
        unknown = torch.where(deviation.isfinite(), deviation.clamp_max(MAX_STOPS), unknown)
    stops = misfit + torch.where(clipped, unknown, rounding)
    return stops.mean(2), clipped.to(photo).mean(2), (stops * clipped).mean(2)


@torch.no_grad()
def gather_evidence(
    field: RadianceField,
    views: Sequence[View],
    *,
    degree: int | None = None,
    truth: bool = False,
    certainties: Sequence[Tensor] | None = None,
) -> Evidence:
    """Gather the evidence of photos for the Gaussians of a field.

    Args:
        field: The trained field.
        views: Training views; pixels that a mask excludes do not count.
        degree: Highest SH degree, by default all.
        truth: The field was trained on HDR truth. If a view has it, it replaces the photo: nothing is clipped and the
            misfit is the whole uncertainty.
        certainties: Of the estimates of each view's clipped light, [h, w, 3], as ClippedLight has them.
    """
    # Of a paged field, pictures are on a GPU and Gaussians are not.
    device, home = field.render_device, field.gaussians.means.device
    total = torch.zeros(field.gaussians.count, 4, device=home)
    peak = torch.zeros(field.gaussians.count, device=home)
    every = -(-len(views) // MAX_VIEWS) or 1
    for index, view in track_progress("measuring confidence on photos", views, log):
        if index % every:
            peak = torch.maximum(peak, blending_weights(field, view.camera, view.mask))
            continue
        exposure = field.render(view.camera, degree=degree).hdr * view.exposure_time
        weight = torch.ones_like(exposure[..., 0])
        if truth and view.hdr is not None:
            observed = torch.tensor(view.hdr, device=device) * view.exposure_time
            stops = (exposure.clamp_min(1e-9) / observed.clamp_min(1e-9)).log2().abs().clamp_max(MAX_STOPS).mean(2)
            clipped = clipped_stops = torch.zeros_like(stops)
        else:
            photo = torch.tensor(view.image, device=device)
            deviation = None if certainties is None else _deviation(certainties[index].to(device), photo)
            stops, clipped, clipped_stops = pixel_uncertainty(photo, exposure, field.response, deviation)
            weight = weight + (RESIDUAL_WEIGHT - 1) * high_residual_mask(view, exposure, field.response)
        if view.mask is not None:
            weight = weight * torch.tensor(view.mask, device=device)
        images = torch.stack([weight, weight * stops, weight * clipped, weight * clipped_stops], dim=2).to(home)
        sums = field.weighted_sums(field.camera_tensors(view.camera), images)
        total += sums
        peak = torch.maximum(peak, sums[:, 0])
    weight_sum = total[:, 0].clamp_min(0)
    stops, clipped, clipped_stops = (total[:, 1:] / weight_sum.clamp_min(1e-12)[:, None]).clamp_min(0).unbind(1)
    return Evidence(weight_sum, stops, clipped.clamp_max(1), peak, clipped_stops)


def _deviation(certainty: Tensor, photo: Tensor) -> Tensor:
    """Return the deviation [H, W, 3], stops, of estimates with a certainty [h, w, 3] at the pixels of a photo.

    It is infinite where there is no estimate.
    """
    rows, columns = (
        torch.arange(size, device=photo.device) * coarse // size
        for size, coarse in zip(photo.shape[:2], certainty.shape[:2], strict=True)
    )
    return 1 / (math.log(2) * certainty[rows][:, columns].to(photo))
