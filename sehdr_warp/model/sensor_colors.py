"""Conversion of sensor RGB to linear Rec.709."""

import numpy as np
import torch
from torch import Tensor

# Fractions of the white level between which a channel's value blends from its own to the clipped estimate.
_CLIPPED = 0.75, 0.95


def rec709_of(radiance: Tensor, matrix: np.ndarray, base_time: float) -> Tensor:
    """Convert radiance in a sensor's own RGB to linear Rec.709.

    All channels of a sensor clip at the same value, so a pixel clipped in all of them would turn magenta by white
    balance alone. A channel near its white level therefore counts as at least as bright as the brightest of the three
    after white balance. Colors outside the Rec.709 gamut have negative components, which are set to 0.

    Args:
        radiance: [..., 3] sensor RGB, in which white is 1 / base_time.
        matrix: [3, 3] from sensor RGB to linear Rec.709, white balance included.
        base_time: Exposure time of the photos, seconds.

    Returns:
        [..., 3] linear Rec.709, >= 0.
    """
    to_rec709 = torch.tensor(matrix, dtype=radiance.dtype, device=radiance.device)
    neutral = torch.linalg.solve(to_rec709, torch.ones_like(to_rec709[0]))
    neutral = neutral / neutral.max()
    exposure = radiance * base_time
    low, high = _CLIPPED
    clipped = ((exposure - low) / (high - low)).clamp(0, 1)
    clipped = clipped * clipped * (3 - 2 * clipped)
    balanced = exposure / neutral
    balanced = balanced + clipped * (balanced.amax(dim=-1, keepdim=True) - balanced)
    return ((balanced * neutral / base_time) @ to_rec709.T).clamp_min(0)
