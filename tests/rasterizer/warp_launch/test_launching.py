"""Launches of Warp kernels on torch's tensors: what they take, share and refuse."""

import pytest
import torch
import warp as wp

from sehdr_warp.rasterizer.warp_launch.launching import launch, sort_pairs


@wp.kernel
def turn(
    range_start: int, matrix: wp.array[wp.mat22], points: wp.array[wp.vec2], offset: wp.array[float], factor: float,
    turned: wp.array[wp.vec2],
):  # fmt: skip
    i = range_start + wp.tid()
    place = factor * (matrix[0] * points[i])
    if offset:
        place += wp.vec2(offset[0], offset[1])
    turned[i] = place


def arguments(device, count=9):
    generator = torch.Generator().manual_seed(0)
    matrix, points, offset = (torch.randn(shape, generator=generator).to(device) for shape in ((2, 2), (count, 2), 2))
    return matrix, points, offset, 3.0, torch.full_like(points, torch.nan)


@pytest.mark.parametrize("with_offset", [True, False])
@pytest.mark.parametrize("count", [0, 1, 9, 5000])
def test_vectors_matrices_numbers_and_null_arrays(device, count, with_offset):
    for factor in (3.0, -1.0):  # A second launch of the same sizes takes other numbers.
        matrix, points, offset, _, turned = arguments(device, count)
        launch(turn, count, matrix, points, offset if with_offset else None, factor, turned)
        expected = factor * points @ matrix.T + (offset if with_offset else 0)
        torch.testing.assert_close(turned, expected)


def test_the_adjoint_adds_to_gradients_that_are_asked_for(device):
    matrix, points, offset, factor, turned = arguments(device)
    grad_points, upstream = torch.ones_like(points), torch.ones_like(points)
    gradients = [None, grad_points, None, None, upstream]
    launch(turn, len(points), matrix, points, offset, factor, turned, gradients=gradients)
    torch.testing.assert_close(grad_points, 1 + (factor * matrix.sum(0)).expand_as(points))


def test_tensors_of_any_strides_and_more_dimensions_are_read_and_written(device):
    matrix, points, offset, factor, turned = arguments(device, 12)
    wide = torch.stack([points, turned], 1)  # Rows that are not neighbors
    launch(turn, 12, matrix, wide[:, 0], offset, factor, wide[:, 1])
    torch.testing.assert_close(wide[:, 1], factor * points @ matrix.T + offset)
    launch(turn, 12, matrix, points.view(3, 4, 2), offset, factor, turned.view(3, 4, 2))
    assert torch.equal(turned, wide[:, 1])


@pytest.mark.parametrize(
    ("place", "change", "message"),
    [
        (1, torch.Tensor.double, r"turn\(\): points takes 1 dimensions of vec2.*, got torch.float64"),
        (1, lambda points: points[:, :1], r"points takes .* of shape \[9, 1\]"),
        (0, lambda matrix: matrix[0], r"matrix takes .* of shape \[2\]"),
        (1, lambda points: points.T.contiguous().T, "points takes .* strides"),
    ],
)
def test_what_does_not_fit_is_named(device, place, change, message):
    values = list(arguments(device))
    values[place] = change(values[place])
    with pytest.raises(TypeError, match=message):
        launch(turn, 9, *values)


@pytest.mark.parametrize("bits", [None, 20])
@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_pairs_are_sorted_stably_by_their_lowest_bits(device, dtype, count, bits):
    keys = torch.randint(1 << 10, (2 * count,), generator=torch.Generator().manual_seed(0)).to(device, dtype)
    values = torch.arange(2 * count, dtype=torch.int32, device=device)
    expected = keys[:count].sort(stable=True)
    sort_pairs(keys, values, count, bits)
    assert torch.equal(keys[:count], expected.values) and torch.equal(values[:count].long(), expected.indices)
