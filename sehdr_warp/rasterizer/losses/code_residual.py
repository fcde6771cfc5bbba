"""Comparison of an image with a photo's codes as a torch operation (kernels/code_residual.py).

Codes stay what the camera stored: uint8, or uint16 as its bits in an int16 tensor, since torch knows little of uint16.
code_tensor() makes such tensors and code_values() the encoded values of them; nothing else needs to know.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from torch import Tensor

from ...kernels import residual_sampling as kernels
from ...kernels.code_residual import code_residual_kernel
from ..ops.plane_sweep import BORDER
from ..torch_contract import once_differentiable
from ..warp_launch.launching import launch, warp_scalar
from ..warp_launch.threads import torch_threads

CODES = {torch.uint8: wp.uint8, torch.int16: wp.uint16}
WHITE = {torch.uint8: 255, torch.int16: 65535}  # The largest code, by the type of the tensor that holds it


def code_tensor(codes: np.ndarray, device: torch.device | str) -> Tensor:
    """Return uint8 or uint16 codes on a device: uint8, or int16 of the same bits. On the CPU they share memory."""
    codes = np.require(codes, requirements=("C", "W"))
    return torch.from_numpy(codes.view(np.int16) if codes.dtype == np.uint16 else codes).to(device)


def code_values(codes: Tensor) -> Tensor:
    """Return the encoded values in [0, 1], float32, of code_tensor()'s codes."""
    integers = codes.int() & 0xFFFF if codes.dtype == torch.int16 else codes
    # By a tensor: torch's division by a number on a GPU is a product with its reciprocal, which rounds differently.
    return integers / torch.full((), float(WHITE[codes.dtype]), device=codes.device)


def photo_stack(codes: Tensor, index: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the codes of a photo, or with an index of several, as [V, 3 H W], and the index [1] int64 of the photo."""
    if index is None:
        codes, index = codes[None], torch.zeros(1, dtype=torch.int64, device=codes.device)
    return codes.contiguous().view(len(codes), -1), index


@dataclass(frozen=True)
class CodeScale:
    """Table of the values by which codes are compared with images.

    Attributes:
        table: [256, 3] or [65536, 3] by code, of the images' type and on their device: value, lower and upper bound of
            a code; -inf or inf for a bound that does not exist. Values increase with the code.
        mu: Images are exposures x, and compared as log(1 + mu x / white) / log(1 + mu); 0 compares them as they are.
        white: Exposure that photos show as white.
        interval_table: The table in which bright codes are intervals; None if there are no such codes.
    """

    table: Tensor
    mu: float = 0.0
    white: float = 1.0
    interval_table: Tensor | None = None

    @property
    def compares_exposures(self) -> bool:
        """Return whether images are exposures, in place of encoded values."""
        return self.mu > 0

    def use_intervals(self) -> None:
        """Treat bright codes as intervals from now on; in place, so that captured CUDA graphs do too."""
        if self.interval_table is not None:
            self.table.copy_(self.interval_table)


def code_residual(image: Tensor, codes: Tensor, scale: CodeScale, index: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return prediction and target of a photo loss, both [H, W, 3] in the domain of the scale.

    Within the interval of values that map to a pixel's code, prediction and target are equal (zero residual).
    Outside, their difference is the distance to the nearest end of the interval. Differentiable once with respect to
    the image.

    Args:
        image: [H, W, 3] float32 or float64.
        codes: code_tensor()'s of the photo, [H, W, 3], or of a stack of photos [V, H, W, 3].
        scale: values of codes: exposures in the mu-law, or encoded values.
        index: [1] int64, of the photo in a stack.

    Raises:
        ValueError: if shapes or dtypes do not fit.
    """
    check_codes(image, codes, scale, index)
    return _CodeResidual.apply(image, codes, scale, index)


def check_codes(image: Tensor, codes: Tensor, scale: CodeScale, index: Tensor | None) -> None:
    """Raise ValueError for what code_residual() does not take."""
    shape = image.shape if index is None else (codes.shape[0], *image.shape)
    levels = WHITE.get(codes.dtype, 0) + 1
    if codes.shape != shape or (levels, 3) != scale.table.shape or scale.table.dtype != image.dtype:
        problem = (
            f"codes are {codes.dtype} {list(codes.shape)} with a table of {scale.table.dtype} {list(scale.table.shape)}"
        )
        raise ValueError(f"{problem}, expected uint8 or int16 {list(shape)} with three {image.dtype} for each code")


def residual(image: Tensor, codes: Tensor, scale: CodeScale, index: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return prediction, target and the slopes d prediction / d image, [H, W, 3], of a contiguous image, detached."""
    prediction, slopes, target = (torch.empty_like(image) for _ in range(3))
    photos, index = photo_stack(codes, index)
    mu_law = (scale.mu / scale.white, 1 / math.log1p(scale.mu)) if scale.compares_exposures else (0.0, 0.0)
    kernel = code_residual_kernel(warp_scalar(image.dtype), CODES[codes.dtype], scale.compares_exposures)
    launch(kernel, image.numel(), image, photos, index, scale.table, *mu_law, prediction, slopes, target)
    return prediction, target, slopes


class _CodeResidual(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, codes, scale, index):
        prediction, target, slopes = residual(image.detach().contiguous(), codes, scale, index)
        ctx.save_for_backward(slopes)
        ctx.mark_non_differentiable(target)
        ctx.set_materialize_grads(False)  # of target there is none, and no zeros are wanted in its place
        return prediction, target

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_prediction, _):
        (slopes,) = ctx.saved_tensors
        if grad_prediction is None:
            return None, None, None, None
        with torch_threads(slopes.device):
            return grad_prediction * slopes, None, None, None


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
    indices = torch.searchsorted(steps, uniform * steps[-1]).clamp_max_(len(steps) - 1)
    pixels = torch.empty(len(indices), 3, dtype=torch.int32, device=rendered.device)
    is_sample = torch.empty(len(indices), dtype=torch.bool, device=rendered.device)
    resized = size[0] / width, size[1] / height, *size, BORDER
    launch(kernels.sampled_pixels, len(indices), indices, steps[-1], width, view, *resized, pixels, is_sample)
    return pixels, is_sample
