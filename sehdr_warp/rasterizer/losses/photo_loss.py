"""The loss of a simulated image against a photo's codes, in the fewest launches.

It joins image_distance() of code_residual()'s pair and clipped_light_energy(): one sum of all terms, and one gradient
that each part continues. The light of clipped pixels costs what it differs from its surroundings and from an estimate
(kernels/clipped_light.py).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ...kernels.clipped_light import clipped_light_kernel, clipped_light_patch_kernel, clipped_logarithms_kernel
from ..warp_launch.launching import launch, warp_scalar
from . import patches
from .code_residual import CODES, WHITE, CodeScale, check_codes, photo_stack, residual
from .ssim import distance_terms


@dataclass(frozen=True)
class ClippedWeights:
    """Weights of the parts of clipped_light_energy(), each at least 0."""

    smoothness: float = 0.0
    estimate: float = 0.0

    def __bool__(self) -> bool:
        """Return whether any part counts."""
        return self.smoothness > 0 or self.estimate > 0


def photo_loss(
    image: Tensor,
    codes: Tensor,
    scale: CodeScale,
    index: Tensor | None = None,
    *,
    distance_weight: float,
    dissimilarity_weight: float,
    clipped: ClippedWeights = ClippedWeights(),
    estimates: Tensor | None = None,
) -> Tensor:
    """Return the photo loss of an image, a scalar, differentiable once with respect to it.

    It is distance_weight mean |a - b| + dissimilarity_weight (1 - ssim(a, b)) of the pair from code_residual(image,
    ...), plus clipped_light_energy() of the image if that has a weight.

    image: [H, W, 3] float32 or float64. codes, scale, index: as of code_residual(), with its errors. clipped: weights
    of clipped_light_energy(), for which scale.white is the exposure that the photo shows as white. estimates: as it
    takes them.
    """
    check_codes(image, codes, scale, index)

    def compute(image: Tensor, needs_gradient: bool) -> tuple[Tensor, Tensor | None]:
        prediction, target, slopes = residual(image, codes, scale, index)
        weights = distance_weight, dissimilarity_weight
        terms, gradient = distance_terms(prediction, target, *weights, needs_gradient, slopes)
        if clipped:
            add_clipped_light(image, codes, scale.white, clipped, index, None, estimates, terms, gradient)
        return terms, gradient

    return patches.loss_of(image, compute)


def clipped_light_energy(
    image: Tensor,
    codes: Tensor,
    white: float,
    weights: ClippedWeights,
    index: Tensor | None = None,
    mask: Tensor | None = None,
    estimates: Tensor | None = None,
) -> Tensor:
    """Return the energy of the clipped values of an image, a scalar, differentiable once with respect to the image.

    It is the mean over all values of the image. With v = log(value / white), and m the mean of v over the clipped
    values of its channel within a few pixels, which is constant in the derivative, a clipped value has

        smoothness / 2 (v - m)^2              light is smooth
        + estimate / 2 ((v - mean) / deviation)^2   an estimate of its light

    Args:
        image: [H, W, 3] exposures, float32 or float64.
        codes: as of code_residual().
        white: the exposure that the photo shows as white; light below it counts as white.
        weights: of the parts.
        index: as of code_residual().
        mask: [H, W, 1], of the image's type; a pixel where it is 0 counts as not clipped.
        estimates: [h, w, 6] float16 for the same picture, sampled at the nearest place: for each channel the expected
            v, and then 1 / its deviation, 0 where nothing is known.
    """

    def compute(image: Tensor, needs_gradient: bool) -> tuple[Tensor, Tensor | None]:
        terms, gradient = patches.new_terms(image).zero_(), torch.zeros_like(image) if needs_gradient else None
        add_clipped_light(image, codes, white, weights, index, mask, estimates, terms, gradient)
        return terms, gradient

    return patches.loss_of(image, compute)


def add_clipped_light(image, codes, white, weights, index, mask, estimates, terms, gradient) -> None:
    """Add the terms that clipped_light_energy() is the sum of to terms, and its gradient to gradient.

    gradient: [H, W, 3], contiguous; may be None.
    """
    photos, index = photo_stack(codes, index)
    mask = None if mask is None else mask.contiguous().view(-1)
    photo = image, photos, index, mask, WHITE[codes.dtype], white
    rows, columns = (0, 0) if estimates is None else estimates.shape[:2]
    estimates = None if estimates is None else estimates.contiguous().view(-1)
    # The mean is in the weights: it costs no launch, here and for the gradient.
    scaled = [weight / image.numel() for weight in (weights.smoothness, weights.estimate)]
    energy = [image.shape[0], image.shape[1], *scaled, estimates, rows, columns, terms, gradient]
    scalar, code = warp_scalar(image.dtype), CODES[codes.dtype]
    if patches.in_patches(image.device):
        arguments = *photo, *energy
        patches.launch_patches(clipped_light_patch_kernel(scalar, code), image, *arguments)
        return
    logarithms = torch.empty_like(image)
    launch(clipped_logarithms_kernel(scalar, code), image.numel(), *photo, logarithms)
    launch(clipped_light_kernel(scalar), image.numel(), image, logarithms, white, *energy)
