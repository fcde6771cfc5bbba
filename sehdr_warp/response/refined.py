"""A response that is corrected together with the scene: a known curve, then an increasing warp of its values."""

import torch
from torch import Tensor, nn

from ..errors import SehdrError
from .curve import HALF_CODE, Response

CELLS = 8
"""Cells of the warp over the encoded values [0, 1]; one half, which keeps its exposure, lies between two of them."""
SHARPEST = 3.0
"""Log densities are held within this: of one half of the values, no slope is more than e^6 = 403 times another."""


class RefinedResponse(nn.Module, Response, kind="refined"):
    """f(x) = w(f_0(x)): f_0 is the start curve, w a warp of [0, 1] onto itself, learned with the scene.

    w' is linear in each of 8 cells with positive values at the nodes, and is normalised over [0, 1/2] and over [1/2, 1]
    apart. So w is strictly increasing, w(0) = 0, w(1) = 1, and w(1/2) = 1/2: the exposure that f_0 encodes as one half
    stays where it is, which anchors the scale of the radiance. At the start w is the identity. What the warp cannot
    do is move the clip point: white keeps its exposure, and so does black.

    start: the curve f_0, which is not learned.
    refining: whether gradients reach the warp; a training holds them back until geometry stands.
    log_densities: [10] parameters, the logarithms of w' at the nodes of the lower and of the upper half.

    A Response in all else; encode_extended is differentiable in exposure and in the warp, decode in neither. Beyond
    the clip point the extension is the start curve's.
    """

    def __init__(self, start: Response):
        super().__init__()
        if isinstance(start, nn.Module):
            raise SehdrError(f"response {start.name}: a learned response cannot be refined; give one that is known")
        self.start = start
        self.refining = True
        self.log_densities = nn.Parameter(torch.zeros(2 * (CELLS // 2 + 1)))
        self.name, self.notes = f"{start.name} refined", start.notes
        self.black, self.peak, self.clip_exposure = start.black, start.peak, start.clip_exposure
        self._offset, self._rise = start.black, start.peak - start.black

    def encode_extended(self, exposure):
        """As Response.encode_extended; a tensor's gradient also reaches the warp while `refining`."""
        if not isinstance(exposure, Tensor):
            return Response.encode_extended(self, exposure)
        value = self.start.encode_extended(exposure)
        inside = (value - self._offset) / self._rise
        over = (inside - 1).clamp_min(0)
        return self._offset + self._rise * (self._warp(inside.clamp(0, 1)) + over)

    @property
    def white(self) -> float:
        """The smallest exposure stored as the brightest 8-bit code, under the warp as it is now."""
        with torch.no_grad():
            return float(self._invert(torch.tensor(self.peak - HALF_CODE, dtype=torch.float64)))

    def penalty(self) -> Tensor:
        """Mean square of the log densities: 0 for the start curve. Scalar, differentiable."""
        return self.log_densities.square().mean()

    def _densities(self) -> Tensor:
        """[2, 5] w' at the nodes of each half, after normalisation."""
        logs = self.log_densities if self.refining else self.log_densities.detach()
        densities = logs.clamp(-SHARPEST, SHARPEST).exp().reshape(2, -1)
        # The trapezoid rule is exact for linear pieces.
        area = (densities.sum(1) - 0.5 * (densities[:, 0] + densities[:, -1])) / (CELLS // 2)
        return densities / area[:, None]

    def _warp(self, value: Tensor) -> Tensor:
        """w of values in [0, 1]: the densities times the integrals of their hat functions. No gather: its gradient
        would be summed by atomics into ten places."""
        nodes = torch.arange(CELLS // 2 + 1, dtype=value.dtype, device=value.device)
        result = torch.zeros_like(value)
        for half, densities in enumerate(self._densities().to(value)):
            near = ((value - 0.5 * half).clamp(0, 0.5)[..., None] * CELLS - nodes).clamp(-1, 1)
            result = result + (near - 0.5 * near * near.abs() + 0.5 * nodes.clamp_max(1)) @ (densities / CELLS)
        return result

    def _evaluate(self, exposure, with_slope):
        value, slope = self.start._evaluate(exposure, with_slope)
        inside = ((value - self._offset) / self._rise).clamp(0, 1)
        warped = self._offset + self._rise * self._warp(inside)
        return warped, slope * self._density(inside) if with_slope else None

    def _density(self, value: Tensor) -> Tensor:
        """w' of values in [0, 1]."""
        nodes = self._densities().to(value)
        half = (value > 0.5).long()
        place = (value - 0.5 * half) * CELLS
        cell = place.floor().clamp(0, CELLS // 2 - 1).long()
        return torch.lerp(nodes[half, cell], nodes[half, cell + 1], place - cell)

    def _invert(self, value):
        wanted = ((value - self._offset) / self._rise).clamp(0, 1)
        nodes = self._densities().to(value)
        steps = 0.5 * (nodes[:, :-1] + nodes[:, 1:]) / CELLS
        sums = torch.cat([torch.zeros_like(steps[:, :1]), steps.cumsum(1)], 1)
        half = (wanted > 0.5).long()
        within = wanted - 0.5 * half
        cell = ((within[..., None] >= sums[half]).sum(-1) - 1).clamp(0, CELLS // 2 - 1)
        rest, low, high = (within - sums[half, cell]) * CELLS, nodes[half, cell], nodes[half, cell + 1]
        # low t + (high - low) t^2 / 2 = rest, by the form of the root that does not cancel.
        part = 2 * rest / (low + (low.square() + 2 * (high - low) * rest).clamp_min(0).sqrt())
        unwarped = (0.5 * half + (cell + part.clamp(0, 1)) / CELLS).clamp(0, 1)
        return self.start._invert(self._offset + self._rise * unwarped)

    def to_dict(self):
        return {"kind": "refined", "start": self.start.to_dict(), "log_densities": self.log_densities.tolist()}

    @classmethod
    def _from_dict(cls, values):
        response = cls(Response.from_dict(values["start"]))
        with torch.no_grad():
            response.log_densities.copy_(torch.tensor(values["log_densities"]))
        return response

    __repr__ = Response.__repr__
