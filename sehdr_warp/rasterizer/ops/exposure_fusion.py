"""Neural exposure fusion of given brackets as a torch operation (kernels/exposure_fusion.py)."""

import torch
from torch import Tensor

from ...kernels.exposure_fusion import POINTS_PER_THREAD, fusion_kernels
from ..checks import check_tensors
from ..gradients import requires_ordered_sums
from ..torch_contract import once_differentiable
from ..warp_launch.launching import launch, warp_scalar
from ..warp_launch.threads import one_torch_thread

MAX_LOG_SIGMA, MAX_DEVIATION = 30.0, 30.0  # Inside these exp(-d^2 / 2) and its gradient are finite in float32


def fuse_exposures(
    encoded: Tensor,
    log_sigma: Tensor,
    inner: Tensor,
    inner_bias: Tensor,
    outer: Tensor,
    outer_bias: Tensor,
    *,
    scale: float,
) -> Tensor:
    """Return [M, 3]: brackets [P, M, 3] summed over P with weights softmax(MLP(gamma, encoded) gamma), times scale.

    gamma = exp(-d^2 / 2), d = (encoded - 0.5) / exp(log_sigma), with log_sigma [3] and d held within their limits. The
    perceptrons, one a channel: inner [3, 2, H], inner_bias [3, 1, H], ReLU, outer [3, H, 1], outer_bias [3, 1, 1].
    Differentiable once, with respect to all tensors. On a GPU by kernels, or by torch's own operations if the brackets
    require a gradient or sums need a fixed order (torch.use_deterministic_algorithms); on the CPU by torch, in a third
    of the kernels' time.
    All contiguous, of one type, float32 or float64, and on one device; raises ValueError otherwise.
    """
    check_tensors(
        encoded=(encoded, ("P", "M", 3)),
        log_sigma=(log_sigma, (3,)),
        inner=(inner, (3, 2, "H")),
        inner_bias=(inner_bias, (3, 1, "H")),
        outer=(outer, (3, "H", 1)),
        outer_bias=(outer_bias, (3, 1, 1)),
    )
    learned = log_sigma, inner, inner_bias, outer, outer_bias
    if encoded.is_cpu:
        with one_torch_thread():  # Sums of matrix products depend on the number of threads.
            return scale * (fusion_weights(encoded, *learned) * encoded).sum(dim=0)
    if encoded.requires_grad or requires_ordered_sums(encoded.device):
        return scale * (fusion_weights(encoded, *learned) * encoded).sum(dim=0)
    return fuse_by_kernels(encoded, *learned, scale)


def fusion_weights(encoded, log_sigma, inner, inner_bias, outer, outer_bias) -> Tensor:
    """Return the weights [P, M, 3] in fuse_exposures(), which sum to 1 over P, by torch's own operations."""
    deviation = (encoded - 0.5) / log_sigma.clamp(-MAX_LOG_SIGMA, MAX_LOG_SIGMA).exp()
    exposedness = (-0.5 * deviation.clamp(-MAX_DEVIATION, MAX_DEVIATION).square()).exp()
    # One product for each channel and bracket: the weights' gradients are sums over many points, which a GPU makes in
    # parallel only across products. Points are the last axis, which halves the time on the CPU.
    points = torch.stack([exposedness, encoded]).permute(3, 1, 0, 2)
    units = inner.mT[:, None] @ points + inner_bias.mT[:, None]
    logits = (outer.mT[:, None] @ units.relu() + outer_bias[:, None])[:, :, 0].permute(1, 2, 0)
    return (logits * exposedness).softmax(dim=0)


class _Fusion(torch.autograd.Function):
    @staticmethod
    def forward(ctx, encoded, log_sigma, inner, inner_bias, outer, outer_bias, scale):
        brackets, count, _ = encoded.shape
        by_channel = encoded.detach().permute(2, 0, 1).reshape(3, -1).contiguous()
        weights = [tensor.detach().contiguous() for tensor in (inner, inner_bias, outer, outer_bias)]
        log_sigma = log_sigma.detach().contiguous()
        exposedness, outputs = torch.empty_like(by_channel), torch.empty_like(by_channel)
        results = encoded.new_empty(count, 3)
        kernels = fusion_kernels(warp_scalar(encoded.dtype))
        inputs = by_channel, log_sigma, MAX_LOG_SIGMA, MAX_DEVIATION, *_flat(weights)
        launch(kernels.perceptrons, by_channel.shape, *inputs, exposedness, outputs)
        launch(kernels.mix, results.shape, by_channel, exposedness, outputs, brackets, scale, results)
        ctx.save_for_backward(by_channel, log_sigma, *weights, exposedness, outputs, results)
        ctx.numbers = brackets, scale
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx, gradients):
        encoded, log_sigma, *weights, exposedness, outputs, results = ctx.saved_tensors
        brackets, scale = ctx.numbers
        grad_exposedness, grad_output, grad_log_sigma = (torch.empty_like(encoded) for _ in range(3))
        sizes = [weight.numel() for weight in weights]
        zeros = encoded.new_zeros(sum(sizes)).split(sizes)
        grad_weights = [part.view(weight.shape) for part, weight in zip(zeros, weights, strict=True)]
        learned = _flat(weights)[:3]
        kernels = fusion_kernels(warp_scalar(encoded.dtype))
        mixed = encoded, exposedness, outputs, brackets, scale, results, gradients.contiguous()
        launch(kernels.mix_backward, results.shape, *mixed, grad_exposedness, grad_output)
        units = 3, -(-encoded.shape[1] // POINTS_PER_THREAD), weights[0].shape[2]
        by_unit = encoded, exposedness, grad_output, *learned, POINTS_PER_THREAD, *_flat(grad_weights)
        launch(kernels.unit_backward, units, *by_unit)
        by_point = encoded, exposedness, grad_exposedness, grad_output, log_sigma, MAX_LOG_SIGMA, MAX_DEVIATION
        arguments = *by_point, *learned, grad_log_sigma
        launch(kernels.point_backward, encoded.shape, *arguments)
        return None, grad_log_sigma.sum(1), *grad_weights, None


fuse_by_kernels = _Fusion.apply
"""fuse_exposures() by kernels on either device; scale is the last argument."""


def _flat(weights):
    """Return inner [3, 2, H], inner_bias [3, H], outer [3, H] and outer_bias [3]: without the axes of length 1."""
    inner, inner_bias, outer, outer_bias = weights
    return inner, inner_bias.view(3, -1), outer.view(3, -1), outer_bias.view(3)
