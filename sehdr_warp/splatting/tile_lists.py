"""The middle stages of a render: records of the projected Gaussians, depth order, and for each tile the list of those
that touch it, front to back."""

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from ..errors import SehdrError
from ..kernels.constants import TILE_SIZE
from ..kernels.tiles import mark_ranges, tile_kernels
from .launching import launch, torch_stream, warp_scalar

LARGEST_CAPACITY = 2**31 - 1  # Entries are counted in int32


@dataclass(frozen=True)
class Emission:
    """Where entries stood before the sort by tile, those of one Gaussian side by side. All indices int32.

    order: [N] Gaussians by depth, nearest first (ties by index; culled ones last).
    ends: [N] running number of entries, by place in `order`.
    places: [M] each entry's place then.
    """

    order: Tensor
    ends: Tensor
    places: Tensor


@dataclass(frozen=True)
class TileLists:
    """Who is drawn where, in which order. All tensors on the render's device, all indices int32.

    ranges: [tiles, 2] first and one past the last entry of each tile.
    gaussians: [M] the Gaussian of each entry, by tile and then front to back.
    emission: how the entries stood by Gaussian; None where it was not asked for.
    width, height: of the image in pixels; columns, rows: tiles across and down.
    overflow: scalar bool, whether a given capacity was too small for all entries; None without a capacity.
    total: scalar int64, how many entries there are, with or without room for them.
    """

    ranges: Tensor
    gaussians: Tensor
    emission: Emission | None
    width: int
    height: int
    overflow: Tensor | None
    total: Tensor

    @property
    def columns(self) -> int:
        return -(-self.width // TILE_SIZE)

    @property
    def rows(self) -> int:
        return -(-self.height // TILE_SIZE)

    @property
    def entry_count(self) -> int:
        """How many (Gaussian, tile) pairs there is room for: all there are, or the capacity."""
        return self.gaussians.shape[0]


@torch.no_grad()
def build_tile_lists(
    records: tuple[Tensor, Tensor],
    depths: Tensor,
    extents: Tensor,
    width: int,
    height: int,
    capacity: int | None = None,
    *,
    emission: bool = True,
) -> TileLists:
    """Order the projected Gaussians by depth and list, for each tile, those whose ellipse touches it.

    records: pack_records()'s; depths, extents: project()'s. Nothing here is differentiable.
    capacity: room for this many entries; those beyond it are left out, which TileLists.overflow tells. The host then
    never waits for the device to learn how many there are.
    emission: also tell where entries came from, which adjoints need that sum by Gaussian in a fixed order.
    Raises SehdrError if the lists would need more than 2^31 - 1 entries.
    """
    columns, rows = -(-width // TILE_SIZE), -(-height // TILE_SIZE)
    tile_count = columns * rows
    order = depth_order(depths, extents)
    touched = order, *records, extents, columns, rows
    counts = count_entries(*touched)
    total = counts.sum(dtype=torch.int64)
    overflow = None if capacity is None else total > capacity
    room = int(total) if capacity is None else capacity
    checked_room(room, len(order), columns, rows)
    ends = counts.cumsum(0, dtype=torch.int32)
    tiles, gaussians = emit_entries(*touched, ends, room, capacity is not None)
    tiles, gaussians, places = sort_by_tile(tiles, gaussians, room, tile_count, emission)
    ranges = find_ranges(tiles, tile_count)
    by_gaussian = None if places is None else Emission(order, ends, places)
    return TileLists(ranges, gaussians, by_gaussian, width, height, overflow, total)


def pack_records(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    extents: Tensor,
    alpha_threshold: float,
    features: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """What is drawn of each projected Gaussian, in rows of four: shapes and ellipses.

    shapes: [N, 4] x, y, opacity, half-height; ellipses: [N, 4] conic a, b, c and the level where alpha meets the
    threshold, -1 where culled.
    features: [N, C]; a Gaussian with one that is not finite is culled: its extents are set to 0. Packed again from the
    same extents, with or without the features, the records are the same bits.
    """
    shapes, ellipses = means2d.new_empty(len(means2d), 4), means2d.new_empty(len(means2d), 4)
    given = (means2d, 0) if features is None else (features, features.shape[1])
    kernel = tile_kernels(warp_scalar(means2d.dtype)).pack_records
    launch(kernel, len(means2d), means2d, conics, opacities, *given, alpha_threshold, extents, shapes, ellipses)
    return shapes, ellipses


def depth_order(depths: Tensor, extents: Tensor) -> Tensor:
    """[N] int32: Gaussians nearest first, culled ones last; equal depths keep the order of their indices."""
    count = depths.shape[0]
    # The sort needs room for twice as many; what is returned does not hold on to it.
    keys = depths.new_empty(2 * count)
    places = torch.empty(2 * count, dtype=torch.int32, device=depths.device)
    launch(tile_kernels(warp_scalar(depths.dtype)).key_by_depth, count, depths, extents, keys, places)
    _sort_pairs(keys, places, count, None)
    return places[:count].clone()


def count_entries(order, shapes, ellipses, extents, columns: int, rows: int):
    """[N] int32: how many tiles each Gaussian touches, by place in `order`."""
    counts = torch.empty_like(order)
    kernel = tile_kernels(warp_scalar(shapes.dtype)).count_tiles
    launch(kernel, len(order), order, shapes, ellipses, extents, columns, rows, counts)
    return counts


def checked_room(room: int, count: int, columns: int, rows: int) -> int:
    """The entries to make room for. Raises SehdrError where they are too many to be counted."""
    if room > LARGEST_CAPACITY:
        raise SehdrError(
            f"{count} Gaussians touch {room} tiles of a {columns} x {rows} tile image, more than 2^31 - 1; "
            "render fewer Gaussians or a smaller image"
        )
    return room


def emit_entries(order, shapes, ellipses, extents, columns: int, rows: int, ends, room: int, padded: bool):
    """One entry for each tile that each Gaussian touches, front to back: tiles and Gaussians, each [2 room], of which
    the first halves are filled; the sort needs the rest. padded: there may be fewer entries than room, and the unused
    ones belong to tile columns * rows."""
    tiles, gaussians = (torch.empty(2 * room, dtype=torch.int32, device=order.device) for _ in range(2))
    if padded:
        tiles[:room] = columns * rows
        gaussians[:room] = 0
    if room:
        kernel = tile_kernels(warp_scalar(shapes.dtype)).emit_entries
        touched = order, shapes, ellipses, extents, columns, rows
        launch(kernel, len(order), *touched, ends, room, tiles, gaussians)
    return tiles, gaussians


def sort_by_tile(tiles, gaussians, entry_count: int, tile_count: int, emission: bool):
    """Stable sort of emit_entries()'s by tile: tiles [M], in the same memory, and copied out of it, which is kept,
    Gaussians [M] and where each entry stood before [M] or None."""
    bits = tile_count.bit_length()
    if not emission:
        _sort_pairs(tiles, gaussians, entry_count, bits)
        return tiles[:entry_count], gaussians[:entry_count].clone(), None
    places = torch.empty(2 * entry_count, dtype=torch.int32, device=tiles.device)
    torch.arange(entry_count, dtype=torch.int32, device=tiles.device, out=places[:entry_count])
    _sort_pairs(tiles, places, entry_count, bits)
    places = places[:entry_count].clone()
    return tiles[:entry_count], gaussians[:entry_count][places] if entry_count else gaussians, places


def find_ranges(tiles, tile_count: int):
    """[tiles, 2] int32: first and one past the last entry of each tile, (0, 0) for an untouched one."""
    ranges = torch.zeros(tile_count, 2, dtype=torch.int32, device=tiles.device)
    launch(mark_ranges, len(tiles), tiles, len(tiles), tile_count, ranges)
    return ranges


def _sort_pairs(keys, values, count: int, bits: int | None) -> None:
    """Sorts keys[:count] and values[:count] by the keys' lowest bits (stable); both have room for 2 count."""
    if count:
        with torch_stream(keys.device):
            wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, end_bit=bits)
