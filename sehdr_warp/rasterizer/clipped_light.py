"""How smooth light is where a photo clips, as a torch operation (kernels/clipped_light.py)."""

import torch
from torch import Tensor

from ..kernels.clipped_light import clipped_light_kernel, clipped_light_patch_kernel, clipped_logarithms_kernel
from . import patches
from .code_residual import CODES, WHITE
from .warp_launch.launching import launch, scale_gradient, warp_scalar


def clipped_light_energy(
    image: Tensor,
    codes: Tensor,
    white: float,
    index: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    smoothness: float,
    lift: float,
) -> Tensor:
    """What a photo leaves open, as smooth as it can be: a scalar, differentiable once with respect to the image.

    The mean over all values of the image, where those that are clipped have smoothness / 2 times the squared difference
    of their log light to the mean of the clipped ones around them, less lift times their log light as far as others
    around them are not clipped. There the blur of Gaussians takes from lights: without a lift, the smaller a light the
    darker it would get. Derivatives are with the means as they are: the light of each follows that of the others.

    image: [H, W, 3] exposures, float32 or float64. codes, index: as of code_residual(). white: the exposure that the
    photo shows as white; light below it counts as white. smoothness, lift: weights, at least 0. mask: [H, W, 1], of the
    image's type; where it is 0 a pixel is as if it were not clipped.
    """
    return _ClippedLight.apply(image, codes, index, mask, white, smoothness, lift)


def add_clipped_light(image, codes, index, mask, white, smoothness, lift, terms, slopes) -> None:
    """Adds what clipped_light_energy() is the total() of to terms, and its derivatives by the image, contiguous, to
    slopes, [H, W, 3], which may be None."""
    if index is None:
        codes, index = codes[None], torch.zeros(1, dtype=torch.int64, device=codes.device)
    photos, mask = codes.contiguous().view(len(codes), -1), None if mask is None else mask.contiguous().view(-1)
    given = image, photos, index, mask, WHITE[codes.dtype], white
    # The mean is in the weights: it costs no launch, here and for the gradient.
    numbers = *image.shape[:2], smoothness / image.numel(), lift / image.numel()
    scalar, code = warp_scalar(image.dtype), CODES[codes.dtype]
    if patches.in_patches(image.device):
        kernel = clipped_light_patch_kernel(scalar, code)
        patches.launch_patches(kernel, image, *given, *numbers, terms, slopes)
        return
    logarithms = torch.empty_like(image)
    launch(clipped_logarithms_kernel(scalar, code), image.numel(), *given, logarithms)
    launch(clipped_light_kernel(scalar), image.numel(), image, logarithms, *numbers, terms, slopes)


class _ClippedLight(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, codes, index, mask, white, smoothness, lift):
        image = image.detach().contiguous()
        terms, slopes = patches.new_terms(image).zero_(), torch.zeros_like(image)
        add_clipped_light(image, codes, index, mask, white, smoothness, lift, terms, slopes)
        ctx.save_for_backward(slopes)
        return patches.total(terms)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_energy):
        (slopes,) = ctx.saved_tensors
        return scale_gradient(slopes, by_energy), None, None, None, None, None, None
