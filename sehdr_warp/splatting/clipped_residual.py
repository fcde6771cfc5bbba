"""Comparison of an image with a photo's codes as a torch operation (kernels/clipped_residual.py).

Codes stay what the camera stored: uint8, or uint16 as its bits in an int16 tensor, since torch knows little of uint16.
code_tensor() makes such tensors and code_values() the encoded values of them; nothing else needs to know.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from torch import Tensor

from ..kernels.clipped_residual import clipped_residual_kernel
from .launching import launch, warp_scalar
from .threads import torch_threads

CODES = {torch.uint8: wp.uint8, torch.int16: wp.uint16}
WHITE = {torch.uint8: 255, torch.int16: 65535}  # The largest code, by the type of the tensor that holds it


def code_tensor(codes: np.ndarray, device: torch.device | str) -> Tensor:
    """uint8 or uint16 codes on a device: uint8, or int16 of the same bits. On the CPU in the array's own memory."""
    codes = np.require(codes, requirements=("C", "W"))
    return torch.from_numpy(codes.view(np.int16) if codes.dtype == np.uint16 else codes).to(device)


def code_values(codes: Tensor) -> Tensor:
    """Encoded values in [0, 1], float32, of code_tensor()'s codes."""
    found = codes.int() & 0xFFFF if codes.dtype == torch.int16 else codes
    # By a tensor: torch's division by a number on a GPU is a product with its reciprocal, which rounds differently.
    return found / torch.full((), float(WHITE[codes.dtype]), device=codes.device)


@dataclass(frozen=True)
class CodeScale:
    """What codes are worth where images are compared with them.

    table: [256] or [65536] by code, of the images' type and on their device, increasing.
    mu, white: images are exposures x, and compared as log(1 + mu x / white) / log(1 + mu); mu = 0: as they are.
    half_codes: in that domain, from white down and from black up to where an image is no longer what the photo shows as
        white and black; None: these are codes like any other.
    """

    table: Tensor
    mu: float = 0.0
    white: float = 1.0
    half_codes: tuple[float, float] | None = None


def clipped_residual(
    image: Tensor, codes: Tensor, scale: CodeScale, index: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """What a photo can tell of an image, and what it tells, both [H, W, 3] in the domain of the scale.

    Where the code is the largest, which says `at least this`, the first equals the second as soon as it is within half
    a code of it or above; where the code is 0, `at most this`, below. Differentiable once with respect to the image.

    image: [H, W, 3] float32 or float64. codes: code_tensor()'s of the photo, [H, W, 3], or of a stack of photos
    [V, H, W, 3] that has it at index [1], int64. All on one device. Raises ValueError otherwise.
    """
    shape = image.shape if index is None else (codes.shape[0], *image.shape)
    levels = WHITE.get(codes.dtype, 0) + 1
    if codes.shape != shape or levels != len(scale.table) or scale.table.dtype != image.dtype:
        given = f"codes are {codes.dtype} {list(codes.shape)} with a table of {len(scale.table)} {scale.table.dtype}"
        raise ValueError(f"{given}, expected uint8 or int16 {list(shape)} with one {image.dtype} for each code")
    return _ClippedResidual.apply(image, codes, scale, index)


class _ClippedResidual(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, codes, scale, index):
        image = image.detach().contiguous()
        seen, slopes, truth = (torch.empty_like(image) for _ in range(3))
        if index is None:
            codes, index = codes[None], torch.zeros(1, dtype=torch.int64, device=codes.device)
        law = (scale.mu / scale.white, 1 / math.log1p(scale.mu)) if scale.mu else (0.0, 0.0)
        # Codes that no pixel has where none of them is special.
        special = (-1, -1, 0.0, 0.0) if scale.half_codes is None else (len(scale.table) - 1, 0, *scale.half_codes)
        kernel = clipped_residual_kernel(warp_scalar(image.dtype), CODES[codes.dtype], scale.mu > 0)
        photos = codes.contiguous().view(len(codes), -1)
        launch(kernel, image.numel(), image, photos, index, scale.table, *law, *special, seen, slopes, truth)
        ctx.save_for_backward(slopes)
        ctx.mark_non_differentiable(truth)
        ctx.set_materialize_grads(False)  # of truth there is none, and no zeros are wanted in its place
        return seen, truth

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_seen, _):
        (slopes,) = ctx.saved_tensors
        if by_seen is None:
            return None, None, None, None
        with torch_threads(slopes.device):
            return by_seen * slopes, None, None, None
