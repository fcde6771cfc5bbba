"""How far the photos vouch for a scene's light: what each Gaussian's weight fell on in the training views.

The sum over a photo's pixels of (weight of a Gaussian) x (number at the pixel) is the derivative of the blend with
respect to that Gaussian's feature, so the splat's own adjoint gathers it for all Gaussians in one pass a view. The
number is how uncertain the pixel leaves its light, in stops; see pixel_uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..response import Response
from ..response.curve import HALF_CODE
from ..scene import View
from .radiance_field import RadianceField
from .unexplained import MOST_VIEWS, unexplained_pixels

CLIPPED_STOPS = 1.0  # Uncertainty of a pixel that is clipped in all channels
PARTLY_CLIPPED_STOPS = 0.25  # Of a clipped channel beside others, which say where the light is, and it the hue
MOST_STOPS = 4.0  # A misfit counts no more than this: 1/16 of the confidence already says that nothing is known
LEAST_SEEN = 0.01  # Pixels of blending weight, over all photos, at which half of the confidence that they give counts
LEAST_CONTRIBUTION = 1 / 255  # Pixels of blending weight in one photo: what has less is not part of the scene
UNEXPLAINED = 8.0  # Times that a pixel counts of what the scene lacks: places behind it are hidden in few photos each


@dataclass(frozen=True)
class Evidence:
    """What the training photos say of each of N Gaussians; [N] each.

    seen: pixels, the sum of its blending weights, UNEXPLAINED times where a photo shows what the scene lacks. stops:
    their mean uncertainty. clipped: the share of their values. peak: pixels, as seen, in the photo that shows it most.
    """

    seen: Tensor
    stops: Tensor
    clipped: Tensor
    peak: Tensor

    @property
    def contributes(self) -> Tensor:
        """[N] bool: whether a Gaussian changes any photo by more than a code of 8 bits, summed over its pixels."""
        return self.peak > LEAST_CONTRIBUTION

    def rows(self, index: Tensor) -> "Evidence":
        """Return the evidence of the Gaussians at an index or mask [N]."""
        return Evidence(self.seen[index], self.stops[index], self.clipped[index], self.peak[index])

    def confidence(self) -> Tensor:
        """[N] in [0, 1]. 1: observed unclipped, and the scene agrees; 1/2: known to a factor of two; 0: never seen."""
        return torch.exp2(-self.stops) * self.seen / (self.seen + LEAST_SEEN)


def pixel_uncertainty(photo: Tensor, exposure: Tensor, response: Response) -> tuple[Tensor, Tensor]:
    """Stops of doubt that a photo leaves about the light at its pixels, and the clipped share of each; [H, W] both.

    photo: [H, W, 3] encoded, in [0, 1]. exposure: [H, W, 3] what the scene shows there, E dt. Mean over channels of

        an unclipped channel    |log2(exposure / decoded value)|, the misfit, plus a quarter of the width of its
                                8-bit code's interval in stops (the mean distance from its middle), at most 1
        a clipped channel       by how much the exposure falls short of white, if it does, plus CLIPPED_STOPS where all
                                channels are clipped, else PARTLY_CLIPPED_STOPS
        a black channel         by how much the exposure is above half a code, if it is, plus 1
    """
    dark = response.decode(photo.new_full((1, 3), HALF_CODE))
    white = response.white
    clipped, black = photo >= 1 - HALF_CODE, photo <= HALF_CODE
    # Below half a code two exposures are the same to the photo.
    lit = torch.maximum(exposure, dark)
    misfit = (lit / torch.maximum(response.decode(photo), dark)).log2().abs()
    misfit = torch.where(clipped, (white / lit).log2().clamp_min(0), misfit)
    misfit = torch.where(black, (lit / dark).log2(), misfit).clamp_max(MOST_STOPS)
    low, high = (response.decode((photo + offset).clamp(0, 1)) for offset in (-HALF_CODE, HALF_CODE))
    rounding = ((high.clamp_min(1e-12) / low.clamp_min(1e-12)).log2() / 4).clamp(0, 1)
    unknown = torch.where(clipped.all(2, keepdim=True), CLIPPED_STOPS, PARTLY_CLIPPED_STOPS).expand_as(photo)
    stops = misfit + torch.where(clipped, unknown, rounding)
    return stops.mean(2), clipped.to(photo).mean(2)


@torch.no_grad()
def gather_evidence(
    field: RadianceField, views: Sequence[View], *, degree: int | None = None, truth: bool = False
) -> Evidence:
    """What the photos of some views say of a field's Gaussians; where a view has a mask, only where it counts.

    truth: the field was trained on HDR truth, which is then what was observed where a view has it: nothing is clipped,
    and the misfit is all the doubt.
    """
    device = field.gaussians.means.device
    total = torch.zeros(field.gaussians.count, 3, device=device)
    peak = torch.zeros(field.gaussians.count, device=device)
    every = -(-len(views) // MOST_VIEWS) or 1
    for index, view in enumerate(views):
        if index % every:
            peak = torch.maximum(peak, _weight(field, view))
            continue
        exposure = field.render(view.camera, degree=degree).hdr * view.exposure_time
        counted = torch.ones_like(exposure[..., 0])
        if truth and view.hdr is not None:
            observed = torch.tensor(view.hdr, device=device) * view.exposure_time
            stops = (exposure.clamp_min(1e-9) / observed.clamp_min(1e-9)).log2().abs().clamp_max(MOST_STOPS).mean(2)
            clipped = torch.zeros_like(stops)
        else:
            stops, clipped = pixel_uncertainty(torch.tensor(view.image, device=device), exposure, field.response)
            counted = counted + (UNEXPLAINED - 1) * unexplained_pixels(view, exposure, field.response)
        if view.mask is not None:
            counted = counted * torch.tensor(view.mask, device=device)
        images = torch.stack([counted, counted * stops, counted * clipped], dim=2)
        sums = field.weighted_sums(field.camera_tensors(view.camera), images)
        total += sums
        peak = torch.maximum(peak, sums[:, 0])
    seen = total[:, 0].clamp_min(0)
    means = total[:, 1:] / seen.clamp_min(1e-12)[:, None]
    return Evidence(seen, means[:, 0].clamp_min(0), means[:, 1].clamp(0, 1), peak)


def _weight(field: RadianceField, view: View) -> Tensor:
    """Return [N], pixels: the sum of each Gaussian's blending weights in a view, where its mask counts."""
    device = field.gaussians.means.device
    counted = torch.ones(view.camera.height, view.camera.width, device=device)
    if view.mask is not None:
        counted = torch.tensor(view.mask, device=device)
    # As wide as a training's features: no further kernel is compiled.
    images = counted[..., None].expand(-1, -1, 3).contiguous()
    return field.weighted_sums(field.camera_tensors(view.camera), images)[:, 0]
