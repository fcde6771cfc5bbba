"""From the light of a sensor's three channels to Rec.709."""

import numpy as np
import torch
from torch import Tensor

# Of a channel's white level: between these its value goes from what was seen to what must at least have been there.
_CLIPPED = 0.75, 0.95


def rec709_of(radiance: Tensor, matrix: np.ndarray, base_time: float) -> Tensor:
    """[..., 3] linear Rec.709 of light in a sensor's own colors, whose channels are white at 1 / base_time.

    matrix: [3, 3], white balance included. Channels clip at one value, which white-balanced is none: bare, what is
    clipped in all would come out magenta. So a channel at its white level counts as at least as bright as the brightest
    of the three, white-balanced. Colors out of Rec.709's gamut have negative parts, which no light has: they become 0.
    """
    given = torch.tensor(matrix, dtype=radiance.dtype, device=radiance.device)
    neutral = torch.linalg.solve(given, torch.ones_like(given[0]))
    neutral = neutral / neutral.max()
    exposure = radiance * base_time
    low, high = _CLIPPED
    clipped = ((exposure - low) / (high - low)).clamp(0, 1)
    clipped = clipped * clipped * (3 - 2 * clipped)
    balanced = exposure / neutral
    balanced = balanced + clipped * (balanced.amax(dim=-1, keepdim=True) - balanced)
    return ((balanced * neutral / base_time) @ given.T).clamp_min(0)
