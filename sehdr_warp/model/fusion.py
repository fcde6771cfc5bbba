"""From base radiance to HDR radiance: neural exposure fusion (SeHDR, equations 9 to 12).

Every bracket is the base scaled by a known ratio, so the fused value is a function of one number: the log radiance of
the base, for each channel separately. The equations are evaluated on a table over that number and interpolated, so that
the cost does not grow with the number of Gaussians; gradients reach the MLPs, the sigmas and the radiances through the
table.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from ..rasterizer.cuda_graphs.runner import is_capturing
from ..rasterizer.ops.exposure_fusion import fuse_exposures
from ..rasterizer.ops.interpolation import interpolate
from ..response.curve import Response
from .exposure import bracket_log_radiance

# The table spans, for every bracket, exposures from where the encoded value is this far above black (a four-hundredth
# of an 8-bit code) to this many octaves above white, where only the response's extension is left: a line in the log.
DARKEST_VALUE, OCTAVES_ABOVE_WHITE = 1e-5, 6.0
START_SIGMA = 0.2
NODES = 1024


class NeuralExposureFusion(nn.Module):
    """NeEF: c^h = radiance_scale * sum_p w_p f(c^{l_p}), w = softmax over p of MLP_c(gamma_p, f(c^{l_p})) gamma_p.

    gamma = exp(-(f(c^{l_p}) - 0.5)^2 / (2 sigma_c^2)), with a learnable sigma_c per channel, and one MLP per channel:
    2 -> width -> 1 with ReLU between and no function at the end.

    forward() applies the equations to NODES values of the log radiance, with Catmull-Rom interpolation between them,
    constant below and linear above. Parameters: log_sigma [3]; weights and biases, one stack over the three channels
    per layer.

    Args:
        response: The curve f, with its extension beyond the clip point.
        times: Exposure times of the n brackets, seconds, as from exposure_times().
        base_time: Exposure time dt_1 of the photos, seconds.
        radiance_scale: Factor on the fused value, which is at most 1; > 0.
        seed: Seed of the MLPs' start values.
        width: Hidden units of each MLP, as in HDR-GS's tone mapper.
    """

    def __init__(
        self,
        response: Response,
        times: Sequence[float],
        base_time: float,
        *,
        radiance_scale: float = 1.0,
        seed: int = 0,
        width: int = 128,
    ):
        """Create the fusion with seeded MLPs; arguments as in the class."""
        super().__init__()
        self.response, self.times, self.base_time = response, tuple(times), base_time
        self.radiance_scale = radiance_scale
        self.log_sigma = nn.Parameter(torch.full((3,), math.log(START_SIGMA)))
        self.weights, self.biases = _channel_layers([2, width, 1], seed)
        brackets = [math.log(time / self.base_time) for time in self.times]
        self._low = math.log(response.decode(response.black + DARKEST_VALUE)) - max(brackets)
        self._node_cache = {}
        self._high = math.log(response.white) + OCTAVES_ABOVE_WHITE * math.log(2) - min(brackets)

    def forward(self, log_base: Tensor) -> Tensor:
        """Return scene-linear radiance c^h [N, 3] of log c^{l_1} [N, 3], the log radiance at the input exposure."""
        step = (self._high - self._low) / (NODES - 1)
        table = fuse_exposures(
            self._encoded_at_nodes(log_base, step), *self._learned_tensors(), scale=self.radiance_scale
        )
        return interpolate(table, self._low, step, log_base)

    def _encode(self, log_base):
        """Return the encoded brackets [n, N, 3] of log_base [N, 3]."""
        return self.response.encode_extended(bracket_log_radiance(log_base, self.times, self.base_time).exp())

    def _learned_tensors(self):
        """Return the learnable arguments of fuse_exposures()."""
        return self.log_sigma, *(part for layer in zip(self.weights, self.biases, strict=True) for part in layer)

    def _encoded_at_nodes(self, like, step):
        """Return the encoded brackets [n, nodes + 2, 3] at the table's nodes; cached unless the curve is learned."""
        key = self.response, like.device, like.dtype
        if key in self._node_cache:
            return self._node_cache[key]
        # One more node at either end, so that every cell has four.
        grid = torch.arange(-1, NODES + 1, dtype=like.dtype, device=like.device) * step + self._low
        encoded = self._encode(grid[:, None].expand(-1, 3))
        # A tensor created during CUDA graph capture is undefined before the first replay, so it is not cached.
        if not self.response.learnable and not is_capturing(like.device):
            self._node_cache[key] = encoded
        return encoded


def _channel_layers(sizes: list[int], seed: int) -> tuple[nn.ParameterList, nn.ParameterList]:
    """Return weights [3, in, out] and biases [3, 1, out], uniform within 1 / sqrt(in) as torch.nn.Linear starts."""
    generator = torch.Generator().manual_seed(seed)

    def layers(rows):
        uniform = (torch.rand(3, rows or a, b, generator=generator) for a, b in pairwise(sizes))
        return nn.ParameterList((2.0 * part - 1.0) * a**-0.5 for part, a in zip(uniform, sizes, strict=False))

    return layers(None), layers(1)
