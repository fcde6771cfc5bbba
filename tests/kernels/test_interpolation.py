"""Interpolation in tables: against the function itself, and the kernels against torch's own operations."""

import pytest
import torch

from sehdr_warp.rasterizer.ops.interpolation import interpolate

from ..rasterizer.scenes import relative_error


def test_values_and_gradients_are_the_references(device):
    generator = torch.Generator().manual_seed(0)
    table = torch.randn(34, 3, generator=generator, dtype=torch.float64)
    # From well below the table to well above it, and exactly on nodes and on both ends of the cells.
    positions = torch.cat([torch.linspace(-3, 9, 1500).repeat(3, 1).T, torch.arange(-1.0, 7.0, 0.25).repeat(3, 1).T])
    low, step = -1.0, 0.25
    truth_table, truth_positions = table.clone().requires_grad_(), positions.double().requires_grad_()
    weights = torch.randn(len(positions), 3, generator=generator)
    truth = interpolate(truth_table, low, step, truth_positions)  # by torch
    (truth * weights).sum().backward()
    ours_table = table.float().to(device).requires_grad_()
    ours_positions = positions.to(device).requires_grad_()
    ours = interpolate(ours_table, low, step, ours_positions)
    (ours * weights.to(device)).sum().backward()
    assert relative_error(ours, truth) < 1e-6
    assert relative_error(ours_table.grad, truth_table.grad) < 1e-5
    assert relative_error(ours_positions.grad, truth_positions.grad) < 1e-5


def test_a_smooth_function_is_met_between_its_nodes(device):
    low, step, nodes = 0.0, 0.1, 64
    grid = torch.arange(-1, nodes + 1, device=device) * step + low
    positions = torch.linspace(0.0, 6.1, 999, device=device)[:, None]
    values = interpolate(torch.sin(grid)[:, None], low, step, positions)
    assert (values - torch.sin(positions)).abs().max() < 2e-4


def test_poison_stays_where_it_is(device):
    table = torch.linspace(0, 1, 20, device=device)[:, None].contiguous()
    positions = torch.tensor([[float("nan")], [0.35], [float("inf")], [-float("inf")]], device=device)
    values = interpolate(table, 0.0, 0.1, positions)
    assert values[0].isnan()
    assert values[1].isfinite()
    assert values[3] == table[1, 0] and not values[2].isfinite()
    assert interpolate(table, 0.0, 0.1, positions[:0]).shape == (0, 1)


@pytest.mark.parametrize("position", [-1e30, -1e-30, 1e-30, 1e6, 1e30])
def test_far_positions_have_the_values_and_slopes_of_float64(device, position):
    table = torch.rand(20, 3, generator=torch.Generator().manual_seed(2)) + torch.arange(20)[:, None]
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = torch.full((1, 3), position, dtype=dtype, device=device).requires_grad_()
        values = interpolate(table.to(device, dtype), 0.0, 0.1, leaf)
        values.sum().backward()
        results.append((values, leaf.grad))
    for ours, truth in zip(*results, strict=True):
        torch.testing.assert_close(ours.double(), truth, rtol=1e-4, atol=1e-5)
