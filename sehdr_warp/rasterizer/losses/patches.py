"""Launches over the patches of an image (kernels/patches.py), and the terms that losses are the sums of."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ...kernels.patches import BLOCK_DIM, patches_of
from ..gradients import scale_gradient
from ..torch_contract import once_differentiable
from ..warp_launch.launching import launch
from ..warp_launch.threads import torch_threads


def in_patches(device: torch.device) -> bool:
    """Return whether kernels of this device work on patches."""
    return device.type == "cuda"


def launch_patches(kernel: Any, image: Tensor, *arguments: Any) -> None:
    """Launch a kernel over the patches of an image [H, W, C]."""
    launch(kernel, patches_of(*image.shape) * BLOCK_DIM, *arguments, block_dim=BLOCK_DIM)


def new_terms(image: Tensor) -> Tensor:
    """Return memory for what total() sums: a term for each patch of an image [H, W, C], or for each of its values."""
    return image.new_empty(patches_of(*image.shape)) if in_patches(image.device) else torch.empty_like(image)


def total(terms: Tensor) -> Tensor:
    """Return the sum of new_terms(), a scalar; on the CPU the same whatever the number of threads."""
    if terms.ndim == 1:
        return terms.sum()
    with torch_threads(terms.device):  # Each row is one thread's.
        rows = terms.flatten(1).sum(1)
    return rows.sum()


def loss_of(image: Tensor, compute: Callable[[Tensor, bool], tuple[Tensor, Tensor | None]]) -> Tensor:
    """Return the total of terms of an image, a scalar, differentiable once with respect to the image.

    compute: returns the terms of the contiguous image and, if its second argument is True, their gradient [H, W, C].
    """
    return _Loss.apply(image, compute)


class _Loss(torch.autograd.Function):
    """The forward pass also computes the gradient; the backward pass multiplies it by that of the loss."""

    @staticmethod
    def forward(ctx, image, compute):
        terms, gradient = compute(image.detach().contiguous(), ctx.needs_input_grad[0])
        ctx.save_for_backward(*(() if gradient is None else (gradient,)))
        return total(terms)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return scale_gradient(ctx.saved_tensors[0], upstream), None
