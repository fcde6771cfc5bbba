"""The two scalar types that the kernels come in."""

import torch
import warp as wp

_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


def warp_scalar(dtype: torch.dtype):
    """wp.float32 or wp.float64; raises TypeError for any other torch dtype."""
    if dtype not in _SCALARS:
        raise TypeError(f"splatting works in float32 and float64, not {dtype}")
    return _SCALARS[dtype]
