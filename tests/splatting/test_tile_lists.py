"""The lists of the tiles: every entry that was counted is written, whatever the two kernels make of a border case."""

import torch

from sehdr_warp.splatting.projection import project
from sehdr_warp.splatting.tile_lists import count_entries, depth_order, emit_entries, find_ranges, pack_records

from .scenes import random_scene

COLUMNS, ROWS, UNWRITTEN = 20, 15, -7
THRESHOLD = 1 / 255


def counted(device, count=20000):
    """Records and counts of a scene dense enough that many ellipses end just at a tile's border."""
    scene = random_scene(count=count, width=16 * COLUMNS, height=16 * ROWS).to(torch.float32, device)
    means, log_scales, quaternions, opacities, _, pose, intrinsics = (tensor.detach() for tensor in scene.tensors)
    projected = project(
        means, log_scales, quaternions, opacities, pose, intrinsics,
        width=16 * COLUMNS, height=16 * ROWS, near=0.01, low_pass=0.3, alpha_threshold=THRESHOLD, antialiased=False,
    )  # fmt: skip
    means2d, conics, depths, opacities2d, extents = projected
    shapes, ellipses = pack_records(means2d, conics, opacities2d, extents, THRESHOLD)
    order = depth_order(depths, extents)
    counts = count_entries(order, shapes, ellipses, extents, COLUMNS, ROWS)
    return (order, shapes, ellipses, extents, COLUMNS, ROWS), counts


def emit(records, counts, monkeypatch):
    """Tiles and Gaussians of the entries, in memory that holds what no tile and no Gaussian is."""
    empty = torch.empty
    monkeypatch.setattr(torch, "empty", lambda *a, **k: empty(*a, **k).fill_(UNWRITTEN))
    room = int(counts.sum())
    tiles, gaussians = emit_entries(*records, counts.cumsum(0, dtype=torch.int32), room, False)
    monkeypatch.undo()
    return tiles[:room], gaussians[:room]


def test_each_counted_tile_is_emitted_once(device, monkeypatch):
    records, counts = counted(device)
    assert int(counts.sum()) > 200_000
    tiles, gaussians = emit(records, counts, monkeypatch)
    assert int(tiles.min()) >= 0 and int(tiles.max()) < COLUMNS * ROWS
    assert torch.equal(gaussians, records[0].repeat_interleave(counts))
    pairs = gaussians.long() * COLUMNS * ROWS + tiles
    assert len(pairs.unique()) == len(pairs)


def test_an_entry_counted_too_much_is_no_tiles_and_one_too_few_costs_its_own_gaussian_only(device, monkeypatch):
    records, counts = counted(device, 500)
    true_tiles, _ = emit(records, counts, monkeypatch)
    first, second = counts.nonzero()[[3, 40], 0].tolist()
    assert int(counts[second]) > 1
    wrong = counts.clone()
    wrong[first] += 2
    wrong[second] -= 1
    tiles, gaussians = emit(records, wrong, monkeypatch)
    assert torch.equal(gaussians, records[0].repeat_interleave(wrong))
    unused = tiles == COLUMNS * ROWS
    assert int(unused.sum()) == 2 and set(gaussians[unused].tolist()) == {int(records[0][first])}
    dropped = int(counts[: second + 1].sum()) - 1
    assert torch.equal(tiles[~unused], torch.cat([true_tiles[:dropped], true_tiles[dropped + 1 :]]))
    ranges = find_ranges(tiles.sort().values, COLUMNS * ROWS)
    assert int((ranges[:, 1] - ranges[:, 0]).sum()) == len(tiles) - 2
