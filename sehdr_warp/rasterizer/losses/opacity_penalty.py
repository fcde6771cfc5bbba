"""The penalty on opacities, with its gradient (kernels/opacity_penalty.py)."""

import torch
from torch import Tensor

from ...kernels.opacity_penalty import opacity_penalty_backward_kernel, opacity_penalty_kernel
from ..torch_contract import once_differentiable
from ..warp_launch.launching import launch, warp_scalar

MEAN_THREADS = 1 << 14


def opacity_penalty(
    opacities: Tensor, extents: Tensor | None, moments: Tensor | None, weight: float, active_count: Tensor | None = None
) -> Tensor:
    """Return `weight` times the sum of the opacities that count over the number of Gaussians, a scalar.

    Gaussians in view count, and those that were in view since they were added; a relocated Gaussian keeps moments, so
    it counts. For the others the penalty would be Adam's only gradient, which fades them at several times its rate
    until a photo shows them: where few photos show a place, they would be gone by then.

    Args:
        opacities: [N] opacities, float32 or float64.
        extents: [N, 2] half-extents of the projected Gaussians, 0 if culled (Rendering.extents); None counts all.
        moments: [N] Adam's second moments of the opacities, 0 from an addition on until a photo shows the Gaussian;
            None for zeros.
        weight: Weight of the mean.
        active_count: [1] int32 on the device, the number of Gaussians if those behind them have an opacity of 0.
    """
    if opacities.device.type == "cuda":
        return penalty_by_kernels(opacities, extents, moments, weight, active_count)
    if extents is not None:
        counts = extents[:, 0] > 0
        counts = counts if moments is None else counts | (moments > 0)
        opacities = torch.where(counts, opacities, 0.0)  # Not 0 times an opacity that is not finite.
    return weight * opacities.sum() / (max(1, len(opacities)) if active_count is None else active_count[0])


class _OpacityPenalty(torch.autograd.Function):
    @staticmethod
    def forward(ctx, opacities, extents, moments, weight, active_count):
        opacities = opacities.detach().contiguous()
        extents = None if extents is None else extents.detach()
        shares = opacities.new_empty(min(len(opacities), MEAN_THREADS))
        kernel = opacity_penalty_kernel(warp_scalar(opacities.dtype))
        launch(kernel, len(shares), opacities, extents, moments, weight, active_count, shares)
        # The moments change after the backward pass, in the optimizer step, and are not of the graph.
        ctx.moments, ctx.weight, ctx.active_count, ctx.count = moments, weight, active_count, len(opacities)
        ctx.save_for_backward(*(() if extents is None else (extents,)))
        return shares.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx, penalty_gradient):
        extents = next(iter(ctx.saved_tensors), None)
        result = penalty_gradient.new_empty(ctx.count)
        kernel = opacity_penalty_backward_kernel(warp_scalar(result.dtype))
        inputs = extents, ctx.moments, ctx.weight, ctx.active_count
        launch(kernel, ctx.count, *inputs, penalty_gradient.reshape(1), result)
        return result, None, None, None, None


penalty_by_kernels = _OpacityPenalty.apply
"""opacity_penalty() by kernels on either device."""
