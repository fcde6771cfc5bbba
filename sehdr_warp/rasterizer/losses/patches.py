"""Launches over the patches of an image (kernels/patches.py), and the terms that losses are the sums of."""

from typing import Any

import torch
from torch import Tensor

from ...kernels.patches import BLOCK_DIM, patches_of
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
