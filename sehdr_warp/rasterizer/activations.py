"""Activations of a Gaussian's parameters before it is drawn, as torch operations (kernels/activations.py)."""

import torch
from torch import Tensor
from torch.nn.functional import hardtanh

from ..kernels.activations import (
    exposures_backward_kernel,
    exposures_kernel,
    opacities_backward_kernel,
    opacities_kernel,
)
from .torch_contract import once_differentiable
from .warp_launch.launching import launch, warp_scalar

MEAN_THREADS = 1 << 14


def bounded_exponential(values: Tensor, bound: float) -> Tensor:
    """Return exp of [N, C] values clamped to [-bound, bound], float32 or float64; NaN stays NaN.

    Beyond the bounds the derivative is 0. Differentiable once.
    """
    if values.device.type == "cuda":
        return _BoundedExponential.apply(values, bound)
    # clamp(), but for the derivative, which is one operation in place of four.
    return hardtanh(values, -bound, bound).exp()


class _BoundedExponential(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, bound):
        values = values.detach().contiguous()
        exponentials = torch.empty_like(values)
        launch(
            exposures_kernel(warp_scalar(values.dtype)), values.numel(), values.view(-1), bound, exponentials.view(-1)
        )
        ctx.bound = bound
        ctx.save_for_backward(values, exponentials)
        return exponentials

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        values, exponentials = ctx.saved_tensors
        result = torch.empty_like(values)
        kernel, inputs = (
            exposures_backward_kernel(warp_scalar(values.dtype)),
            (values.view(-1), ctx.bound, exponentials.view(-1)),
        )
        launch(kernel, values.numel(), *inputs, upstream, result.view(-1))
        return result, None


def opacities_with_penalty(logits: Tensor, weight: float, active_count: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return the sigmoids of [N] logits, N >= 1, and `weight` times their mean, a scalar; differentiable once.

    active_count: [1] int32 on the device, how many the mean counts, if those behind them have a sigmoid of 0.
    """
    if logits.device.type == "cuda":
        return _Opacities.apply(logits, weight, active_count)
    opacities = torch.sigmoid(logits)
    return opacities, weight * (opacities.mean() if active_count is None else opacities.sum() / active_count[0])


class _Opacities(torch.autograd.Function):
    @staticmethod
    def forward(ctx, logits, weight, active_count):
        logits = logits.detach().contiguous()
        opacities, shares = torch.empty_like(logits), logits.new_empty(min(len(logits), MEAN_THREADS))
        launch(
            opacities_kernel(warp_scalar(logits.dtype)), len(shares), logits, weight, active_count, opacities, shares
        )
        ctx.weight, ctx.active_count = weight, active_count
        ctx.save_for_backward(opacities)
        ctx.set_materialize_grads(False)
        return opacities, shares.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_opacities, grad_mean):
        (opacities,) = ctx.saved_tensors
        result = torch.empty_like(opacities)
        kernel, inputs = (
            opacities_backward_kernel(warp_scalar(opacities.dtype)),
            (opacities, ctx.weight, ctx.active_count),
        )
        launch(kernel, len(opacities), *inputs, grad_opacities, grad_mean, result)
        return result, None, None
