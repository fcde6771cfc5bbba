"""New Gaussians where the photos are explained worst, at the depths that the photos agree on."""

import math

import numpy as np
import torch
from torch import Tensor

from ..field.radiance_field import RadianceField
from ..splats.arrays import HARMONIC_0
from .matching import Matcher
from .targets import TrainingView

MOST = 500  # Gaussians that are born at a change
OPACITY = 0.5  # Of one that is born: it must be seen to be shaped
LEAST_ERROR = 0.02  # Mean difference of encoded values from which a pixel is not explained


@torch.no_grad()
def born_rows(
    field: RadianceField, matcher: Matcher, shown: Tensor, view: TrainingView, index: int, count: int, seed: int
) -> dict[str, Tensor]:
    """Rows of up to `count` Gaussians, as Gaussians.append takes them: of pixels drawn by the square of their error.

    shown: [H, W, 3] encoded, the scene from `view`. matcher: of the training photos, in which that of the view
    is the one at `index`. The same seed gives the same rows.
    """
    rng = np.random.default_rng(seed)
    found = matcher.match(_unexplained(shown.clamp(0, 1), matcher, view, index, min(count, MOST), rng))
    start = torch.from_numpy(field.color_model.start(found.colors.cpu().numpy(), field.response))
    rest = field.gaussians.harmonics_rest
    count = len(found.points)
    return {
        "means": found.points,
        "log_scales": found.footprints.log()[:, None].repeat(1, 3),
        "quaternions": rest.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "opacity_logits": rest.new_full((count,), math.log(OPACITY / (1 - OPACITY))),
        "harmonics_dc": (start / HARMONIC_0).to(rest)[:, None, :],
        "harmonics_rest": rest.new_zeros(count, *rest.shape[1:]),
    }


def _unexplained(photo: Tensor, matcher: Matcher, view: TrainingView, index: int, count: int, rng) -> Tensor:
    """[up to count, 3] pixels of a photo, as the matcher takes them."""
    error = (photo - view.target.encoded).abs().mean(2, keepdim=True)
    if view.target.mask is not None:
        error = error * view.target.mask
    steps = torch.where(error > LEAST_ERROR, error, 0.0).square().double().flatten().cumsum(0)
    uniform = torch.from_numpy(rng.random(count)).to(steps)
    place = torch.searchsorted(steps, uniform * steps[-1]).clamp_max(len(steps) - 1)
    width, height = view.camera.width, view.camera.height
    ratio = matcher.sizes[index] / matcher.sizes.new_tensor([width, height])
    column_and_row = torch.stack([place % width, place // width], 1).add(0.5) * ratio
    pixels = torch.cat([torch.full_like(place[:, None], index), column_and_row.long()], 1).int()
    return pixels[matcher.inside(pixels) & (steps[-1] > 0)]
