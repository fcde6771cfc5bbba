"""Interpolation in a table of functions as a torch operation (kernels/interpolation.py)."""

import torch

from ..kernels import interpolation
from .launching import launch


def interpolate(table: torch.Tensor, low: float, step: float, positions: torch.Tensor) -> torch.Tensor:
    """[N, C] values at positions [N, C] of C functions given at equal steps (Catmull and Rom 1974).

    table: [nodes + 2, C] float32, column c holding function c at low - step, low, low + step ...; nodes from 2. Below
    `low` a function is constant, above its last node but one a straight line. Differentiable once with respect to table
    and positions; on a GPU sums by node are made in no fixed order.
    Raises ValueError for a table that is too short or for shapes, types or devices that do not fit.
    """
    fits = table.ndim == positions.ndim == 2 and table.shape[1] == positions.shape[1] and table.shape[0] >= 4
    same = table.dtype == positions.dtype == torch.float32 and table.device == positions.device
    if not (fits and same):
        raise ValueError(
            f"interpolate takes float32 [nodes + 2, C] and [N, C] on one device, not {table.dtype} {list(table.shape)} "
            f"on {table.device} and {positions.dtype} {list(positions.shape)} on {positions.device}"
        )
    return _Interpolation.apply(table, low, step, positions)


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
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradients):
        table, positions = ctx.saved_tensors
        copies = 1 if table.device.type == "cpu" else interpolation.COPIES
        by_position, by_node = torch.empty_like(positions), table.new_zeros(copies, *table.shape)
        given = table, ctx.low, 1.0 / ctx.step, positions, gradients.contiguous()
        launch(interpolation.interpolate_adjoint, positions.shape, *given, by_position, by_node)
        return by_node.sum(0), None, None, by_position
