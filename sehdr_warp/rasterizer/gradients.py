"""Memory, layout and sums of gradients, and scalars that cost no launch."""

from collections.abc import Sequence
from functools import cache
from itertools import accumulate

import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from ..kernels.tiles import tile_kernels
from .warp_launch.launching import launch, warp_scalar
from .warp_launch.threads import torch_threads


def zero_gradients(tensors: Sequence[Tensor], needed: Sequence[bool]) -> list[Tensor | None]:
    """Return zeros to accumulate into for each tensor that needs a gradient, and None for the others.

    On a GPU the gradients of leaves share one allocation, filled by one launch; others are freed soon, each by itself.
    """
    device = tensors[0].device
    if device.type == "cpu":
        with torch_threads(device):
            return [_zeros(tensor) if need else None for tensor, need in zip(tensors, needed, strict=True)]
    leaves = [index for index, tensor in enumerate(tensors) if needed[index] and tensor.is_leaf]
    zeros = dict(zip(leaves, _zeros_together([tensors[index] for index in leaves]), strict=False))
    return [
        zeros[index] if index in zeros else _zeros(tensors[index]) if need else None
        for index, need in enumerate(needed)
    ]


def _zeros(like: Tensor) -> Tensor:
    return torch.zeros_like(like, memory_format=torch.contiguous_format)


def _zeros_together(tensors: list[Tensor]) -> list[Tensor]:
    """Return zeros of the tensors' shapes in one allocation; none unless they are several, alike and contiguous."""
    alike = len({tensor.dtype for tensor in tensors}) == 1 and all(tensor.is_contiguous() for tensor in tensors)
    if len(tensors) < 2 or not alike:
        return []
    # Each starts at a multiple of 64 numbers, as memory of its own would.
    lengths = [-(-tensor.numel() // 64) * 64 for tensor in tensors]
    zeros, starts = tensors[0].new_zeros(sum(lengths)), accumulate(lengths, initial=0)
    return [zeros.as_strided(t.shape, t.stride(), start) for t, start in zip(tensors, starts, strict=False)]


def sum_by_gaussian(grad_intersections: Tensor, order: Tensor | None, cumulative_counts: Tensor) -> Tensor:
    """Return [N, columns]: the sum over the intersections of each Gaussian, in the order of tiles.

    grad_intersections: [M, columns] at TileLists.emit_indices. order, cumulative_counts: of TileLists.emit_order.
    """
    assert order is not None, "intersections of one Gaussian are not neighbors"
    length, columns = grad_intersections.shape
    sums = grad_intersections.new_zeros(len(order), columns)
    if length:
        cumulative_counts = cumulative_counts.clamp(0, length)  # Nothing is beyond max_intersections.
        kernel = tile_kernels(warp_scalar(sums.dtype)).gather_intersections
        launch(kernel, len(order), order, cumulative_counts, grad_intersections, columns, sums)
    return sums


def kernel_layout(gradient: Tensor) -> Tensor:
    """Return a gradient as kernels read it: contiguous, or with any stride from row to row; no negated view."""
    if gradient.is_neg():
        gradient = gradient.resolve_neg()  # The imaginary part of a conjugate, as in losses of Fourier transforms.
    if gradient.ndim < 2 or gradient.is_contiguous():
        return gradient
    rows_are_contiguous = gradient.stride(1) == 1 if gradient.ndim == 2 else gradient[0].is_contiguous()
    return gradient if rows_are_contiguous else gradient.contiguous()


@cache
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a shared vector of these values, which nobody may change."""
    with torch.inference_mode(False), _disable_current_modes():  # The vector outlives the caller's modes.
        return torch.tensor(values, dtype=dtype, device=device)


def unit_gradient(like: Tensor) -> Tensor:
    """Return the shared scalar 1 of a tensor's type and device, which scale_gradient() recognizes."""
    return constant((1.0,), like.dtype, like.device)[0]


def scale_gradient(gradient: Tensor, upstream: Tensor) -> Tensor:
    """Return gradient * upstream, or the gradient itself if the scalar upstream is unit_gradient()."""
    return gradient if upstream.data_ptr() == unit_gradient(upstream).data_ptr() else gradient * upstream


def requires_ordered_sums(device: torch.device) -> bool:
    """Return whether sums must have a fixed order, which atomics of a GPU's threads do not keep."""
    return device.type == "cuda" and torch.are_deterministic_algorithms_enabled()
