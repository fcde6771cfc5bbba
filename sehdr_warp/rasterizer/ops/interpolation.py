"""Interpolation in a table of functions as a torch operation (kernels/interpolation.py)."""

import torch
from torch import Tensor

from ...kernels import interpolation
from ..checks import check_tensors
from ..gradients import requires_ordered_sums
from ..torch_contract import once_differentiable
from ..warp_launch.launching import launch


def interpolate(table: Tensor, low: float, step: float, positions: Tensor) -> Tensor:
    """Return values [N, C] at positions [N, C] of C functions tabulated at equal steps (Catmull and Rom 1974).

    table: [nodes + 2, C], column c holding function c at low - step, low, low + step ...; nodes from 2. Below `low` a
    function is constant, above its last node but one a straight line. Differentiable once with respect to table and
    positions. By a kernel, or by torch's own operations in float64 and, on a GPU, where torch is asked for a fixed
    order of sums (torch.use_deterministic_algorithms).
    Raises ValueError for a table that is too short or for shapes, types or devices that do not fit.
    """
    check_tensors(table=(table, ("nodes + 2", "C")), positions=(positions, ("N", "C")))
    if len(table) < 4:
        raise ValueError(f"table has shape {list(table.shape)}, expected [nodes + 2, C] with 2 nodes at least")
    if table.dtype == torch.float64 or requires_ordered_sums(table.device):
        return _in_torch(table, low, step, positions)
    return _Interpolation.apply(table, low, step, positions)


def _in_torch(table: Tensor, low: float, step: float, positions: Tensor) -> Tensor:
    nodes = table.shape[0] - 2
    position = ((positions - low) / step).clamp_min(0.0)
    cell = position.detach().nan_to_num(0.0).clamp_max(nodes - 2).long()
    part = position - cell
    before, left, right, after = (table.gather(0, cell + offset) for offset in range(4))
    slope_left, slope_right = 0.5 * (right - before), 0.5 * (after - left)
    inside, rise = part.clamp_max(1.0), right - left
    cubic = slope_left + slope_right - 2.0 * rise
    square = 3.0 * rise - 2.0 * slope_left - slope_right
    value = left + inside * (slope_left + inside * (square + inside * cubic))
    return value + (part - inside) * slope_right


class _Interpolation(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table, low, step, positions):
        table, positions = table.detach().contiguous(), positions.detach().contiguous()
        values = torch.empty_like(positions)
        launch(interpolation.interpolate, positions.shape, table, low, 1.0 / step, positions, values)
        ctx.save_for_backward(table, positions)
        ctx.low, ctx.step = low, step
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx, gradients):
        table, positions = ctx.saved_tensors
        copies = 1 if table.device.type == "cpu" else interpolation.COPIES
        grad_positions, grad_table = torch.empty_like(positions), table.new_zeros(copies, *table.shape)
        inputs = table, ctx.low, 1.0 / ctx.step, positions, gradients.contiguous()
        launch(interpolation.interpolate_backward, positions.shape, *inputs, grad_positions, grad_table)
        return grad_table.sum(0), None, None, grad_positions
