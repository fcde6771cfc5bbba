"""How smooth light is where a photo clips, as a torch operation (kernels/clipped_light.py)."""

import torch
from torch import Tensor

from ..kernels.clipped_light import clipped_light_kernel, clipped_logarithms_kernel
from .code_residual import CODES, WHITE
from .launching import launch, times, warp_scalar


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


def add_clipped_light(image, codes, index, mask, white, smoothness, lift, energies, slopes) -> None:
    """Adds clipped_light_energy()'s terms to energies, and their derivatives by the image, contiguous, to slopes, both
    [H, W, 3]; slopes may be None."""
    logarithms = torch.empty_like(image)
    if index is None:
        codes, index = codes[None], torch.zeros(1, dtype=torch.int64, device=codes.device)
    # The mean is in the weights: it costs no launch, here and for the gradient.
    weights = smoothness / image.numel(), lift / image.numel()
    scalar, numbers = warp_scalar(image.dtype), (*image.shape[:2], *weights)
    photos, mask = codes.contiguous().view(len(codes), -1), None if mask is None else mask.contiguous().view(-1)
    found = image, photos, index, mask, WHITE[codes.dtype], white, logarithms
    launch(clipped_logarithms_kernel(scalar, CODES[codes.dtype]), image.numel(), *found)
    launch(clipped_light_kernel(scalar), image.numel(), image, logarithms, *numbers, energies, slopes)


class _ClippedLight(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, codes, index, mask, white, smoothness, lift):
        image = image.detach().contiguous()
        energies, slopes = torch.zeros_like(image), torch.zeros_like(image)
        add_clipped_light(image, codes, index, mask, white, smoothness, lift, energies, slopes)
        ctx.save_for_backward(slopes)
        return energies.sum()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_energy):
        (slopes,) = ctx.saved_tensors
        return times(slopes, by_energy), None, None, None, None, None, None
