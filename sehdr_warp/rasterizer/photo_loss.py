"""The loss of a simulated image against a photo's codes, in the fewest launches.

It joins image_distance() of code_residual()'s pair and clipped_light_energy(): one sum of all terms, and one gradient
that each part continues.
"""

import torch
from torch import Tensor

from .clipped_light import ClippedWeights, add_clipped_light
from .code_residual import CodeScale, check_codes, residual
from .gradients import scale_gradient
from .patches import total
from .ssim import distance_terms
from .torch_contract import once_differentiable


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
    weights = distance_weight, dissimilarity_weight
    return _PhotoLoss.apply(image, codes, scale, index, weights, clipped, estimates)


class _PhotoLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, codes, scale, index, weights, clipped, estimates):
        image = image.detach().contiguous()
        prediction, target, slopes = residual(image, codes, scale, index)
        terms, gradient = distance_terms(
            prediction, target, *weights, needs_gradient=ctx.needs_input_grad[0], slopes=slopes
        )
        if clipped:
            add_clipped_light(image, codes, scale.white, clipped, index, None, estimates, terms, gradient)
        ctx.save_for_backward(*(() if gradient is None else (gradient,)))
        return total(terms)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return scale_gradient(ctx.saved_tensors[0], upstream), None, None, None, None, None, None
