"""torch tensors as kernel arguments."""

import torch
import warp as wp

_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


def warp_scalar(dtype: torch.dtype):
    """wp.float32 or wp.float64; raises TypeError for any other torch dtype."""
    if dtype not in _SCALARS:
        raise TypeError(f"splatting works in float32 and float64, not {dtype}")
    return _SCALARS[dtype]


def view(tensor: torch.Tensor, dtype=None):
    """A bare descriptor of the tensor's memory for a launch that no tape records.

    It costs the host a third of a wp.array and keeps the tensor alive for as long as it lives itself.
    A vector or matrix dtype takes up the last one or two dimensions.
    """
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)
