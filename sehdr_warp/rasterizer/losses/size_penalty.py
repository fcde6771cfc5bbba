"""The penalty on angular sizes, with its gradient (kernels/size_penalty.py)."""

import torch
from torch import Tensor

from ...kernels.size_penalty import size_penalty_backward_kernel, size_penalty_kernel
from ..torch_contract import once_differentiable
from ..warp_launch.launching import launch, warp_scalar
from .opacity_penalty import MEAN_THREADS

LEAST_DISTANCE = 1e-3
"""Gaussians nearer to the camera count as at this distance, normalized units."""


def size_penalty(
    log_scales: Tensor, means: Tensor, position: Tensor, weight: float, active_count: Tensor | None = None
) -> Tensor:
    """Return `weight` times the mean of all standard deviations over the distance from a camera, a scalar.

    Adam moves a parameter by about its rate however small its gradient is. So a small weight shrinks the Gaussians that
    no photo supports, and hardly changes the others. 3DGS-MCMC (equation 10) has sizes in world units in their place.

    Args:
        log_scales: [N, 3] natural logarithms of standard deviations, float32 or float64.
        means: [N, 3]; they get no gradient.
        position: [3] of the camera.
        weight: Weight of the mean.
        active_count: [1] int32 on the device, the number of Gaussians, if rows behind them are reserved.
    """
    return _SizePenalty.apply(log_scales, means, position, weight, active_count)


class _SizePenalty(torch.autograd.Function):
    @staticmethod
    def forward(ctx, log_scales, means, position, weight, active_count):
        log_scales, means = log_scales.detach().contiguous(), means.detach().contiguous()
        place = position.detach().reshape(1, 3).contiguous()
        shares = log_scales.new_empty(min(len(log_scales), MEAN_THREADS))
        kernel = size_penalty_kernel(warp_scalar(log_scales.dtype))
        launch(kernel, len(shares), log_scales, means, place, LEAST_DISTANCE, weight, active_count, shares)
        ctx.weight, ctx.active_count = weight, active_count
        ctx.save_for_backward(log_scales, means, place)
        return shares.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx, penalty_gradient):
        log_scales, means, place = ctx.saved_tensors
        result = torch.empty_like(log_scales)
        kernel = size_penalty_backward_kernel(warp_scalar(result.dtype))
        inputs = log_scales, means, place, LEAST_DISTANCE, ctx.weight, ctx.active_count
        launch(kernel, len(result), *inputs, penalty_gradient.reshape(1), result)
        return result, None, None, None, None
