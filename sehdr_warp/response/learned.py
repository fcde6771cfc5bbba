"""A learned tone mapper in place of a camera response: one small perceptron for each channel, as in HDR-GS."""

import math
from typing import Any

import numpy as np
import torch
from torch import nn

from ..errors import SehdrError
from ..rasterizer.ops.interpolation import interpolate
from .curve import HALF_CODE, Response

EXPOSURE_FLOOR = 1e-6  # Added to exposures before the logarithm: a hundredth of 8-bit black in sRGB
# The table from which many exposures are encoded, in their logarithm; below it f is constant, above straight. Fewer
# than EXACT_BELOW are encoded without it.
LOG_RANGE, LOG_NODES, EXACT_BELOW = (-20.0, 12.0), 2048, 4096
# Exposures between which decode() looks for a value, and how many it looks at.
TABLE_RANGE, TABLE_NODES = (1e-6, 1e6), 8192


class ToneMapper(nn.Module, Response, kind="mlp"):
    """f_c(x) = sigmoid(MLP_c(log x)) for the channels c: exposure x = E dt to an encoded value, learned with the scene.

    Source: HDR-GS (Cai et al., NeurIPS 2024): a hidden layer of 128 with ReLU, weights as torch.nn.Linear starts them,
    here turned so that the function rises at first but for a few bends. Nothing keeps it rising, and nothing in photos
    of one exposure determines its scale.

    A Response whose tensors end in a dimension of three channels. encode and encode_extended are the same and
    differentiable in exposure and weights; decode searches a table of the weights as they are, on values made to
    increase, and is not differentiable.

    width: hidden units, at least 1; seed: of the start weights.
    """

    name = "learned"
    learnable = True
    black, peak, clip_exposure = 0.0, 1.0, math.inf

    def __init__(self, width: int = 128, seed: int = 0):
        """Initialize the weights, so that all channels rise; raise SehdrError if the width is not a number from 1."""
        super().__init__()
        if not isinstance(width, int) or isinstance(width, bool) or width < 1:
            raise SehdrError(f"tone mapper: width = {width!r} is not a number from 1")
        self.width = width
        generator = torch.Generator().manual_seed(seed)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for inputs, outputs in ((1, width), (width, 1)):
            for parameters, rows in ((self.weights, inputs), (self.biases, 1)):
                start = 2 * torch.rand(3, rows, outputs, generator=generator) - 1
                parameters.append(nn.Parameter(start / math.sqrt(inputs)))
        self._start_rising()

    @torch.no_grad()
    def _start_rising(self) -> None:
        """Flip each of four groups of units (active towards dark or light, at log x = 0 or not) if it falls."""
        inner, bias, outer = self.weights[0].mT, self.biases[0].mT, self.weights[1]
        for towards in (inner < 0, inner > 0):
            for group in (towards & (bias < 0), towards & (bias >= 0)):
                falls = (inner * outer * group).sum(1, keepdim=True) < 0
                outer[group & falls] *= -1

    def encode(self, exposure: Any) -> Any:
        """Return encoded values in (0, 1) of exposures [..., 3], a tensor for a tensor, else a NumPy array."""
        if isinstance(exposure, torch.Tensor):
            return self.encode_log((exposure.clamp_min(0) + EXPOSURE_FLOOR).log())
        return self._with_arrays(self.encode, exposure)

    def encode_extended(self, exposure: Any) -> Any:
        """Return encode(exposure), because the sigmoid leaves a gradient everywhere."""
        return self.encode(exposure)

    def encode_log(self, log_exposure: torch.Tensor) -> torch.Tensor:
        """Return encoded values in (0, 1) of log exposures [..., 3]; large inputs are interpolated in a table."""
        points = log_exposure.reshape(-1, 3)
        if len(points) < EXACT_BELOW or points.dtype != torch.float32 or torch.are_deterministic_algorithms_enabled():
            return self._logits(points).sigmoid().reshape(log_exposure.shape)
        step = (LOG_RANGE[1] - LOG_RANGE[0]) / (LOG_NODES - 1)
        grid = torch.arange(-1, LOG_NODES + 1, dtype=torch.float32, device=points.device) * step + LOG_RANGE[0]
        table = self._logits(grid[:, None].expand(-1, 3))
        return interpolate(table, LOG_RANGE[0], step, points).sigmoid().reshape(log_exposure.shape)

    def _logits(self, log_exposure):
        # By products and sums: cuBLAS gains nothing here, and a recorded step would depend on its workspace.
        (inner, outer), (inner_bias, outer_bias) = self.weights, self.biases
        activations = torch.addcmul(inner_bias, log_exposure.T[..., None], inner).relu()
        return ((activations * outer.mT).sum(2) + outer_bias[..., 0]).T

    @torch.no_grad()
    def decode(self, value: Any) -> Any:
        """Return the exposures [..., 3] whose encoded values these are, within TABLE_RANGE."""
        if not isinstance(value, torch.Tensor):
            return self._with_arrays(self.decode, value)
        low, high = (math.log(exposure) for exposure in TABLE_RANGE)
        nodes = torch.linspace(low, high, TABLE_NODES, dtype=torch.float32, device=self.weights[0].device)
        table = self.encode_log(nodes[:, None].expand(-1, 3)).cummax(0).values.T.contiguous()
        encoded = value.to(table).reshape(-1, 3).T.contiguous()
        after = torch.searchsorted(table, encoded).clamp(1, TABLE_NODES - 1)
        left, right = table.gather(1, after - 1), table.gather(1, after)
        part = ((encoded - left) / (right - left).clamp_min(1e-12)).clamp(0, 1)
        exposures = (nodes[after - 1] + part * (nodes[after] - nodes[after - 1])).exp()
        return exposures.T.reshape(value.shape).to(value)

    def slope(self, exposure: Any) -> Any:
        """Return df/dx of encode, shaped like the exposures [..., 3]; it is not differentiable."""
        if not isinstance(exposure, torch.Tensor):
            return self._with_arrays(self.slope, exposure)
        with torch.enable_grad():
            leaf = exposure.detach().requires_grad_()
            return torch.autograd.grad(self.encode(leaf).sum(), leaf)[0]

    def start_exposures(self, encoded):
        """Return exp(encoded), as HDR-GS starts, because the mapper is not trained yet."""
        return np.exp(np.asarray(encoded, np.float64))

    @property
    def white(self) -> float:
        """The smallest exposure at which every channel is within half an 8-bit code of 1, within TABLE_RANGE."""
        return float(self.decode(torch.full((1, 3), 1 - HALF_CODE)).max())

    def to_dict(self) -> dict:
        """Return the mapper's shape; the weights are in state_dict()."""
        return {"kind": "mlp", "width": self.width}

    @classmethod
    def _from_dict(cls, values):
        return cls(values["width"])

    def _with_arrays(self, function, argument):
        array = np.asarray(argument)
        tensor = torch.tensor(array, dtype=torch.float32, device=self.weights[0].device)
        with torch.no_grad():
            return function(tensor).cpu().numpy().astype(array.dtype if array.dtype.kind == "f" else np.float64)

    def _encode(self, exposure, extension_slope):
        return self.encode(exposure), self.slope(exposure)

    def _invert(self, value):
        return self.decode(value)

    def __repr__(self) -> str:
        """Return the class and name."""
        return Response.__repr__(self)
