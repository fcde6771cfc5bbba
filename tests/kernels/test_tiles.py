"""Tiles that Gaussians touch, and sums of their gradients, against NumPy in float64."""

import numpy as np
import pytest
import torch

from sehdr_warp.rasterizer.gradients import sum_by_gaussian
from sehdr_warp.rasterizer.tile_lists import build_tile_lists, depth_order, order_gaussians

from ..rasterizer.scenes import packed, random_scene

WIDTH, HEIGHT, THRESHOLD = 70, 50, 1 / 255


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("in_order", [True, False])
def test_lists_hold_what_pixels_show_in_order_of_depth(device, dtype, in_order):
    """Nothing that a pixel of the tile shows is missing, hardly anything more is listed, and the nearest is first."""
    splats = packed(random_scene(width=WIDTH, height=HEIGHT).to(dtype, device), THRESHOLD)
    order = order_gaussians(splats, keep_emit_order=in_order)
    lists = build_tile_lists(splats, order, WIDTH, HEIGHT, keep_emit_order=in_order)
    (x, y, opacity, _), (a, b, c, _) = (rows.double().cpu().numpy().T[..., None, None] for rows in splats[:2])
    rows, columns = np.mgrid[:64, :80] + 0.5
    dx, dy = columns - x, rows - y
    alpha = opacity * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha[splats.extents[:, 0].cpu() == 0] = 0
    visible = (alpha > THRESHOLD).reshape(-1, 4, 16, 5, 16).any((2, 4)).reshape(-1, 20)
    in_list, depths = np.zeros_like(visible), splats.depths.double().cpu().numpy()
    for tile, (begin, end) in enumerate(lists.tile_ranges.tolist()):
        here = lists.gaussians[begin:end].cpu().numpy()
        in_list[here, tile] = True
        assert len(set(here)) == len(here) and (np.diff(depths[here]) >= 0).all()
    assert not (visible & ~in_list).any() and (in_list & ~visible).sum() < 0.05 * visible.sum() and visible.sum() > 200
    np.testing.assert_array_equal(splats.counts.cpu(), in_list.sum(1))


@pytest.mark.parametrize("count", [0, 1, 300])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-14)])
def test_gradients_are_summed_by_gaussian(device, dtype, bound, count):
    rng = np.random.default_rng(0)
    counts, order = rng.integers(0, 5, count), rng.permutation(count).astype(np.int32)
    gradients = rng.normal(size=(counts.sum(), 7)) * 10.0 ** rng.integers(-20, 20, (counts.sum(), 1))
    expected = np.zeros((count, 7))
    np.add.at(expected, order.repeat(counts), gradients)
    inputs = torch.tensor(gradients, dtype=dtype), torch.from_numpy(order), torch.from_numpy(counts.cumsum())
    sums = sum_by_gaussian(*(tensor.to(device) for tensor in inputs)).double().cpu()
    np.testing.assert_allclose(sums, expected, rtol=100 * bound, atol=bound * 1e-15)


def test_culled_gaussians_are_last_and_equal_depths_keep_their_order(device):
    depths = torch.tensor([3.0, 1e-38, 2.0, 3e38, 2.0, 1.0], device=device)
    extents = torch.ones(6, 2, device=device)
    extents[5] = 0
    assert depth_order(depths, extents).tolist() == [1, 2, 4, 0, 3, 5]
