"""The lists of the tiles: every counted intersection is written, whatever the two kernels make of a border case."""

import pytest
import torch

from sehdr_warp.kernels.tiles import DEPTH_BITS
from sehdr_warp.rasterizer import tile_lists
from sehdr_warp.rasterizer.tile_lists import (
    EmitOrder,
    PackedSplats,
    TileGrid,
    build_tile_lists,
    depth_order,
    depths_along,
    emit_intersections,
    find_tile_ranges,
    order_gaussians,
)
from sehdr_warp.rasterizer.warp_launch.launching import sort_pairs

from .emulated_graphs import tensors_of
from .scenes import packed, projected, random_scene

GRID, UNWRITTEN = TileGrid(columns=20, rows=15), -7


def dense(device, count=20000):
    """A scene, packed, dense enough that many ellipses end just at a tile's border."""
    return packed(random_scene(count=count, width=16 * GRID.columns, height=16 * GRID.rows).to(torch.float32, device))


def counted(*scene):
    """The order of the Gaussians, the packed ones, and the counts in that order."""
    splats = dense(*scene)
    order = depth_order(splats.depths, splats.extents)
    return order, splats, splats.counts[order]


def built(splats, max_intersections=None, *, keep_emit_order=True):
    emit_order = order_gaussians(splats, keep_emit_order=keep_emit_order)
    return build_tile_lists(
        splats, emit_order, 16 * GRID.columns, 16 * GRID.rows, max_intersections, keep_emit_order=keep_emit_order
    )


def emit(order, splats, counts, monkeypatch):
    """Tiles and Gaussians of the intersections, in memory that holds what no tile and no Gaussian is."""
    empty = torch.empty
    monkeypatch.setattr(torch, "empty", lambda *a, **k: empty(*a, **k).fill_(UNWRITTEN))
    capacity = int(counts.sum())
    emit_order = EmitOrder(order, counts.cumsum(0))
    tiles, gaussians = emit_intersections(splats, emit_order, GRID, capacity)
    monkeypatch.undo()
    return tiles[:capacity], gaussians[:capacity]


def test_each_counted_tile_is_emitted_once(device, monkeypatch):
    order, splats, counts = counted(device)
    assert int(counts.sum()) > 200_000
    tiles, gaussians = emit(order, splats, counts, monkeypatch)
    assert int(tiles.min()) >= 0 and int(tiles.max()) < GRID.tiles
    assert torch.equal(gaussians, order.repeat_interleave(counts))
    pairs = gaussians.long() * GRID.tiles + tiles
    assert len(pairs.unique()) == len(pairs)


def test_an_intersection_counted_too_much_has_no_tile_and_one_too_few_costs_its_own_gaussian_only(device, monkeypatch):
    order, splats, counts = counted(device, 500)
    true_tiles, _ = emit(order, splats, counts, monkeypatch)
    first, second = counts.nonzero()[[3, 40], 0].tolist()
    assert int(counts[second]) > 1
    wrong = counts.clone()
    wrong[first] += 2
    wrong[second] -= 1
    tiles, gaussians = emit(order, splats, wrong, monkeypatch)
    assert torch.equal(gaussians, order.repeat_interleave(wrong))
    unused = tiles == GRID.tiles
    assert int(unused.sum()) == 2 and set(gaussians[unused].tolist()) == {int(order[first])}
    dropped = int(counts[: second + 1].sum()) - 1
    assert torch.equal(tiles[~unused], torch.cat([true_tiles[:dropped], true_tiles[dropped + 1 :]]))
    ordered = tiles.sort(stable=True)
    ranges, _ = find_tile_ranges(ordered.values, gaussians[ordered.indices], splats, GRID)
    assert int((ranges[:, 1] - ranges[:, 0]).sum()) == len(tiles) - 2


@pytest.mark.parametrize("spare", [0, 7, -1000])
def test_one_sort_makes_the_lists_of_two(device, spare):
    splats = dense(device)
    # Many at one depth: ties keep the order of indices.
    splats = splats._replace(depths=(splats.depths * 4).round().clamp_min(1) / 4)
    lists = built(splats)
    capacity = lists.intersection_count + spare
    emit_order = EmitOrder(None, splats.counts.cumsum(0))
    keys, gaussians = emit_intersections(splats, emit_order, GRID, capacity)
    sort_pairs(keys, gaussians, capacity, DEPTH_BITS + GRID.tiles.bit_length())
    keys, gaussians = keys[:capacity], gaussians[:capacity]
    ranges, corners = find_tile_ranges(keys, gaussians, splats, GRID)
    if spare < 0:
        assert int(ranges[-1, 1]) == capacity and int(keys.max() >> DEPTH_BITS) < GRID.tiles
        return
    assert torch.equal(gaussians[: lists.intersection_count], lists.gaussians)
    assert torch.equal(ranges, lists.tile_ranges)
    assert lists.subtile_masks is None or torch.equal(corners[: lists.intersection_count], lists.subtile_masks)


def test_depths_beyond_the_bits_of_the_keys_keep_their_order_up_to_ties(device):
    """Keys tell depths from 2^-40 to 2^88 apart; nearer and farther ones are alike, in the order of indices."""
    depths = torch.tensor([1e30, 3e38, 1e-30, 1e-38, 1.0, 1e20, 1e-10], device=device)
    splats = packed(random_scene(count=7, width=16, height=16).to(torch.float32, device))
    x, cutoff = torch.tensor([8.0, 8.0, 0.5, 8.0], device=device), torch.tensor([1.0, 0.0, 1.0, 9.0], device=device)
    everywhere = {"means_opacities": x.repeat(7, 1), "conics_cutoffs": cutoff.repeat(7, 1)}
    one = {"counts": torch.ones_like(splats.counts), "extents": torch.full_like(splats.extents, 3.0)}
    splats = splats._replace(depths=depths, **everywhere, **one)
    for keep_emit_order, expected in ((False, [2, 3, 6, 4, 5, 0, 1]), (True, [3, 2, 6, 4, 5, 0, 1])):
        emit_order = order_gaussians(splats, keep_emit_order=keep_emit_order)
        assert build_tile_lists(splats, emit_order, 16, 16).gaussians.tolist() == expected


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("axis", [(0, 0, 0), (NAN, NAN, NAN), (NAN, 0, 1), (1, 0, NAN), (INF, 0, 1)])
def test_an_axis_of_no_direction_orders_as_the_cameras_own(device, axis):
    """On a GPU nothing else looks at its numbers."""
    scene = random_scene(count=500).to(torch.float32, device)
    gaussians = projected(scene)
    along = depths_along(torch.tensor(axis, dtype=torch.float32, device=device), gaussians, scene.arguments[6])
    assert torch.equal(along, gaussians.depths * along.new_tensor(0.001)) and along.max() > 0


def test_subtiles_are_those_that_an_ellipse_touches(device):
    """Beside what all pixels of a subtile see of a Gaussian, drawn alone."""
    scene = random_scene(count=40, width=32, height=32, spread=0.8, seed=3).to(torch.float32, device)
    splats = packed(scene)
    lists = build_tile_lists(splats, order_gaussians(splats, keep_emit_order=False), 32, 32)
    columns, rows = torch.meshgrid(torch.arange(32.0, device=device), torch.arange(32.0, device=device), indexing="xy")
    (x, y, *_), (a, b, c, cutoff) = (record[lists.gaussians.long()].t()[..., None, None] for record in splats[:2])
    dx, dy = columns + 0.5 - x, rows + 0.5 - y
    visible = a * dx * dx + 2 * b * dx * dy + c * dy * dy <= cutoff
    lengths = (lists.tile_ranges[:, 1] - lists.tile_ranges[:, 0]).long()
    tiles = torch.repeat_interleave(torch.arange(4, device=device), lengths)
    # Rows of tiles, of subtiles, of pixels; then columns of each.
    by_subtile = visible.view(-1, 2, 4, 4, 2, 2, 8).any(6).any(3)[torch.arange(len(tiles)), tiles // 2, :, tiles % 2]
    flags = (lists.subtile_masks[:, None].int() >> torch.arange(8, device=device)) & 1
    assert len(tiles) == lists.intersection_count > 40 and 0.1 < flags.float().mean() < 0.9
    # An ellipse may pass between the pixels of a subtile that it touches.
    assert not (by_subtile.reshape(-1, 8) & ~flags.bool()).any()
    assert (by_subtile.reshape(-1, 8) == flags.bool()).float().mean() > 0.95


@pytest.mark.parametrize("keep_emit_order", [False, True])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_overflow_is_more_intersections_than_capacity(device, keep_emit_order, count):
    size = {"width": 16 * GRID.columns, "height": 16 * GRID.rows}
    scene = packed(random_scene(count=count, **size, seed=3).to(torch.float32, device))
    intersections = built(scene, keep_emit_order=keep_emit_order).intersection_count
    for capacity in {max(1, intersections + spare) for spare in (-1, 0, 1)}:
        lists = built(scene, capacity, keep_emit_order=keep_emit_order)
        assert bool(lists.overflow) == (intersections > capacity) and lists.total == intersections


@pytest.mark.parametrize("spare", [None, 7])
@pytest.mark.parametrize("keep_emit_order", [False, True])
def test_lists_keep_no_more_memory_than_they_use(device, keep_emit_order, spare):
    scene = dense(device, 500)
    exact = built(scene, keep_emit_order=keep_emit_order)
    lists = exact if spare is None else built(scene, exact.intersection_count + spare, keep_emit_order=keep_emit_order)
    intersections = exact.intersection_count + (spare or 0)
    assert torch.equal(lists.gaussians[: exact.intersection_count], exact.gaussians)
    total_and_overflow = 8 + (spare is not None)
    by_gaussian = intersections + 3 * 500 if keep_emit_order else 0
    one_sort = 0 if keep_emit_order else 4 * intersections + 8 * 500 - 8
    masks = 0 if lists.subtile_masks is None else intersections
    total = 4 * (2 * GRID.tiles + intersections + by_gaussian) + masks + total_and_overflow + one_sort
    assert sum(tensor.untyped_storage().nbytes() for tensor in tensors_of(lists)) == total


@pytest.mark.parametrize("keep_emit_order", [True, False])
@pytest.mark.parametrize("count, chunks", [(0, 1), (1, 3), (5000, 7)])
def test_intersections_counted_by_chunks_are_those_sorted(monkeypatch, count, chunks, keep_emit_order):
    monkeypatch.setattr(tile_lists, "MIN_CHUNK", max(1, count // chunks))
    monkeypatch.setenv("SEHDR_THREADS", str(chunks))
    generator, grid = torch.Generator().manual_seed(count), TileGrid(40, 1)
    # Some belong to no tile, and some tiles have none.
    tile_keys = [torch.randint(3, grid.tiles + 1, (2 * count,), generator=generator, dtype=torch.int32)]
    tile_keys.append(torch.randint(1000, (2 * count,), generator=generator, dtype=torch.int32))
    splats = PackedSplats(torch.zeros(1000, 4), torch.full((1000, 4), -1.0), None, None, None)
    counted = tile_lists.count_by_tile(*(tensor.clone() for tensor in tile_keys), count, None, grid, keep_emit_order)
    copies = (tensor.clone() for tensor in tile_keys)
    ranges, ones, corners, places = tile_lists.sort_by_tile(*tile_keys, count, splats, grid, keep_emit_order)
    alike, *_, without, _ = tile_lists.sort_by_tile(*copies, count, None, grid, keep_emit_order)
    assert torch.equal(alike, ranges) and without is None and len(corners) == count
    ours_ranges, ours_ones, _, ours_places = counted
    for ours, sorted_ones in zip((ours_ranges, ours_ones, ours_places), (ranges, ones, places), strict=True):
        assert (ours is None) == (sorted_ones is None)
        assert ours is None or torch.equal(ours, sorted_ones[: len(ours)])
