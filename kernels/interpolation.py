"""Catmull-Rom interpolation of tables of one variable, and its backward pass.

A column of the table holds one function at equal steps, with one node more at either end. Below the first cell a
function is constant, above the last one a straight line.
"""

import warp as wp

from .constants import NO_AUTODIFF
from .geometry import vector

COPIES = 128
"""The backward pass adds to this many tables in turn, summed afterwards: on a GPU thousands of threads would otherwise
wait for the few nodes that most values fall between."""

_weights4 = vector(4, wp.float32)


@wp.func
def cell_of(position: float, last_cell: int) -> int:
    """Return the cell of a position, from 0 to last_cell; 0 for NaN."""
    cell = int(0)
    if position > 0.0:  # not for NaN
        cell = int(wp.min(position, float(last_cell)))
    return cell


@wp.func
def node_weights(part: float) -> _weights4:
    """Return the weights of the four nodes around a cell, for a place 0 <= part <= 1 in it, or beyond the last cell."""
    t = wp.min(part, 1.0)
    beyond = part - t
    right_value = t * t * (3.0 - 2.0 * t)
    left_slope = t * (1.0 + t * (t - 2.0))
    right_slope = t * t * (t - 1.0) + beyond
    return _weights4(
        -0.5 * left_slope, 1.0 - right_value - 0.5 * right_slope, right_value + 0.5 * left_slope, 0.5 * right_slope
    )


@wp.func
def weight_slopes(part: float) -> _weights4:
    """Return the derivatives of node_weights() by the part of the cell."""
    t = wp.min(part, 1.0)
    right_value = 6.0 * t * (1.0 - t)
    left_slope = 1.0 + t * (3.0 * t - 4.0)
    right_slope = t * (3.0 * t - 2.0)
    return _weights4(
        -0.5 * left_slope, -right_value - 0.5 * right_slope, right_value + 0.5 * left_slope, 0.5 * right_slope
    )


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def interpolate(
    table: wp.array2d(dtype=wp.float32),
    low: float, inverse_step: float,
    positions: wp.array2d(dtype=wp.float32), values: wp.array2d(dtype=wp.float32),
):
    """Interpolate a table [nodes + 2, C], whose row 1 is the node at `low`; positions, values: [N, C]."""
    i, column = wp.tid()
    position = wp.max((positions[i, column] - low) * inverse_step, 0.0)
    cell = cell_of(position, table.shape[0] - 4)
    weights = node_weights(position - float(cell))
    value = float(0.0)
    for node in range(4):
        value += weights[node] * table[cell + node, column]
    values[i, column] = wp.where(wp.isnan(positions[i, column]), positions[i, column], value)


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def interpolate_backward(
    table: wp.array2d(dtype=wp.float32),
    low: float, inverse_step: float,
    positions: wp.array2d(dtype=wp.float32), grad_values: wp.array2d(dtype=wp.float32),
    position_gradients: wp.array2d(dtype=wp.float32), table_gradients: wp.array3d(dtype=wp.float32),
):
    """Add to table_gradients [copies, nodes + 2, C], and write the other gradients [N, C]."""
    i, column = wp.tid()
    offset = (positions[i, column] - low) * inverse_step
    position = wp.max(offset, 0.0)
    cell = cell_of(position, table.shape[0] - 4)
    part = position - float(cell)
    weights = node_weights(part)
    slopes = weight_slopes(part)
    gradient = grad_values[i, column]
    slope = float(0.0)
    copy = i % table_gradients.shape[0]
    for node in range(4):
        slope += slopes[node] * table[cell + node, column]
        if gradient != 0.0:  # As of most Gaussians that a photo does not show
            wp.atomic_add(table_gradients, copy, cell + node, column, weights[node] * gradient)
    if offset < 0.0:
        slope = float(0.0)
    position_gradients[i, column] = wp.where(wp.isnan(offset), offset, gradient * slope * inverse_step)
