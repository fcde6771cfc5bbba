"""Sample pixels with a high residual, on either device without waiting for it (kernels/residual_sampling.py)."""

import torch
from torch import Tensor

from ..kernels import residual_sampling as kernels
from .code_residual import CODES, WHITE, photo_stack
from .plane_sweep import BORDER
from .warp_launch.launching import launch


@torch.no_grad()
def sample_residual_pixels(
    rendered: Tensor,
    codes: Tensor,
    index: Tensor | None,
    mask: Tensor | None,
    uniform: Tensor,
    view: int,
    size: tuple[int, int],
    *,
    least: float,
) -> tuple[Tensor, Tensor]:
    """Sample pixels by the square of their error, if it is above `least`.

    Returns [K, 3] int32 (view, column, row) of the photo at another size (width, height), each BORDER from its edge,
    and [K] bool, whether each is meant.

    rendered: [H, W, 3] encoded, float32, clamped to [0, 1]. codes, index: as of code_residual(). mask: [H, W, 1]
    float32, by which errors are multiplied. uniform: [K] float64 in [0, 1), random numbers of the draws.
    """
    height, width, _ = rendered.shape
    photos, index = photo_stack(codes, index)
    mask = None if mask is None else mask.contiguous().view(-1)
    weights = torch.empty(height * width, dtype=torch.float64, device=rendered.device)
    inputs = rendered.contiguous().view(-1, 3), photos, index, float(WHITE[codes.dtype]), mask, least
    launch(kernels.error_weights_kernel(CODES[codes.dtype]), len(weights), *inputs, weights)
    steps = weights.cumsum(0)
    places = torch.searchsorted(steps, uniform * steps[-1]).clamp_max_(len(steps) - 1)
    pixels = torch.empty(len(places), 3, dtype=torch.int32, device=rendered.device)
    is_sample = torch.empty(len(places), dtype=torch.bool, device=rendered.device)
    resized = size[0] / width, size[1] / height, *size, BORDER
    launch(kernels.sampled_pixels, len(places), places, steps[-1], width, view, *resized, pixels, is_sample)
    return pixels, is_sample
