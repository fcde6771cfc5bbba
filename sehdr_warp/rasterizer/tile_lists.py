"""The middle stages of a render: records of the projected Gaussians, depth order, and for each tile the list of those
that touch it, front to back."""

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from ..errors import SehdrError
from ..kernels import tiles as kernels
from ..kernels.constants import TILE_SIZE
from ..kernels.tiles import tile_kernels
from ..parallel import thread_count
from .warp_launch.launching import launch, torch_stream, warp_scalar
from .warp_launch.threads import torch_threads

MAX_INTERSECTIONS = 2**31 - 1  # Entries are counted in int32
ONE_SORT = 1 << 18
"""Up to so many Gaussians lists are made by one sort on a GPU, which then waits for the host rather than for memory."""
SMALLEST_CHUNK = 1 << 14  # Of intersections, that are worth handing to another thread


@dataclass(frozen=True)
class UnsortedIntersections:
    """Where intersections stood before the sort by tile, those of one Gaussian side by side. All indices int32.

    order: [N] Gaussians by depth, nearest first (ties by index; culled ones last).
    ends: [N] int64 running number of intersections, by place in `order`.
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
    corners: [M] uint8, bit k where the entry's ellipse touches corner k of its tile; None on the CPU, where none is
        asked for.
    unsorted: how the intersections stood by Gaussian; None where it was not asked for.
    width, height: of the image in pixels; columns, rows: tiles across and down.
    overflow: scalar bool, whether a given max_intersections was too small for all intersections; None without a
    max_intersections.
    total: scalar int64, how many intersections there are, with or without room for them.
    """

    ranges: Tensor
    gaussians: Tensor
    corners: Tensor | None
    unsorted: UnsortedIntersections | None
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
    def intersection_count(self) -> int:
        """How many (Gaussian, tile) pairs there is room for: all there are, or the max_intersections."""
        return self.gaussians.shape[0]


@torch.no_grad()
def order_intersections(
    counts: Tensor, depths: Tensor, extents: Tensor, *, unsorted: bool = True
) -> tuple[Tensor | None, Tensor]:
    """The order in which Gaussians are entered, by depth, or None where they are as they come; and by place in it the
    running number of intersections, [N] int64.

    counts: pack_gaussians()'s; depths, extents: project()'s. unsorted: as build_tile_lists() is asked for it.
    """
    one_sort = len(depths) <= ONE_SORT and not unsorted and depths.dtype == torch.float32
    order = None if one_sort else depth_order(depths, extents)
    return order, (counts if order is None else _taken(counts, order)).cumsum(0)


@torch.no_grad()
def build_tile_lists(
    records: tuple[Tensor, Tensor],
    order: Tensor | None,
    ends: Tensor,
    depths: Tensor,
    extents: Tensor,
    width: int,
    height: int,
    max_intersections: int | None = None,
    *,
    unsorted: bool = True,
) -> TileLists:
    """Order the projected Gaussians by depth and list, for each tile, those whose ellipse touches it.

    records: pack_gaussians()'s for an image of this size; order, ends: order_intersections()'s; depths, extents:
    project()'s. Nothing here is differentiable.
    max_intersections: room for this many intersections; those beyond it are left out, which TileLists.overflow tells.
    The host then never waits for the device to learn how many there are.
    unsorted: also tell where intersections came from, which adjoints need that sum by Gaussian in a fixed order.
    Raises SehdrError if the lists would need more than 2^31 - 1 intersections.
    """
    columns, rows = -(-width // TILE_SIZE), -(-height // TILE_SIZE)
    tile_count, count = columns * rows, len(depths)
    total = ends[-1] if count else ends.new_zeros(())
    overflow = None
    if max_intersections is not None:  # Written as Gaussians are entered, if there are any: to compare is a launch.
        overflow = (torch.empty if count else torch.zeros)((), dtype=torch.bool, device=ends.device)
    room = check_intersection_count(
        int(total) if max_intersections is None else max_intersections, count, columns, rows
    )
    by_gaussian = None
    if order is None:
        touched = *records, extents, depths, columns, rows
        keys, gaussians = sort_keys(*emit_keys(*touched, ends, room, overflow), room, tile_count)
        ranges, corners = find_lists(keys, gaussians, records, columns, rows)
    else:
        touched = order, *records, extents, columns, rows
        tiles, gaussians = emit_intersections(*touched, ends, room, overflow)
        given = tiles, gaussians, room, records, columns, rows, unsorted
        ranges, gaussians, corners, places = lists_by_tile(*given)
        by_gaussian = None if places is None else UnsortedIntersections(order.clone(), ends, places)
        total = total.clone()
    return TileLists(ranges, gaussians, corners, by_gaussian, width, height, overflow, total)


def pack_gaussians(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    extents: Tensor,
    alpha_threshold: float,
    width: int,
    height: int,
    features: Tensor | None = None,
) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """What is drawn of each projected Gaussian, in rows of four, shapes and ellipses; and the tiles that it touches.

    shapes: [N, 4] x, y, opacity, half-height; ellipses: [N, 4] conic a, b, c and the level where alpha meets the
    threshold, -1 where culled. counts: [N] int64.
    features: [N, C]; a Gaussian with one that is not finite is culled: its extents are set to 0.
    """
    count = len(means2d)
    shapes, ellipses = means2d.new_empty(count, 4), means2d.new_empty(count, 4)
    counts = torch.empty(count, dtype=torch.int64, device=means2d.device)
    given = (means2d, 0) if features is None else (features, features.shape[1])
    tiles = -(-width // TILE_SIZE), -(-height // TILE_SIZE)
    kernel = tile_kernels(warp_scalar(means2d.dtype)).pack_gaussians
    arguments = means2d, conics, opacities, *given, alpha_threshold, *tiles, extents
    launch(kernel, count, *arguments, shapes, ellipses, counts)
    return (shapes, ellipses), counts


def depth_order(depths: Tensor, extents: Tensor) -> Tensor:
    """[N] int32: Gaussians nearest first, culled ones last; equal depths keep the order of their indices. The first
    half of memory that the sort needs."""
    count = depths.shape[0]
    keys = depths.new_empty(2 * count)
    places = torch.empty(2 * count, dtype=torch.int32, device=depths.device)
    launch(tile_kernels(warp_scalar(depths.dtype)).key_by_depth, count, depths, extents, keys, places)
    _sort_pairs(keys, places, count, None)
    return places[:count]


def check_intersection_count(room: int, count: int, columns: int, rows: int) -> int:
    """The intersections to make room for. Raises SehdrError where they are too many to be counted."""
    if room > MAX_INTERSECTIONS:
        raise SehdrError(
            f"{count} Gaussians touch {room} tiles of a {columns} x {rows} tile image, more than 2^31 - 1; "
            "render fewer Gaussians or a smaller image"
        )
    return room


def emit_intersections(order, shapes, ellipses, extents, columns: int, rows: int, ends, room: int, overflow=None):
    """One entry for each tile that each Gaussian touches, front to back: tiles and Gaussians, each [2 room], of which
    the first halves are filled; the sort needs the rest. Entries that there is room for and that are not used belong
    to tile columns * rows. overflow: scalar bool, is told whether there are more than there is room for."""
    tiles, gaussians = (torch.empty(2 * room, dtype=torch.int32, device=order.device) for _ in range(2))
    if not len(order):
        tiles[:room], gaussians[:room] = columns * rows, 0
    elif room:
        kernel = tile_kernels(warp_scalar(shapes.dtype)).emit_intersections
        touched = order, shapes, ellipses, extents, None, columns, rows
        launch(kernel, len(order), *touched, ends, room, tiles, gaussians, overflow)
    return tiles, gaussians


def emit_keys(shapes, ellipses, extents, depths, columns: int, rows: int, ends, room: int, overflow=None):
    """As emit_intersections, of Gaussians as they come: int64 keys, the tile above those of the depth, and
    Gaussians."""
    keys = torch.empty(2 * room, dtype=torch.int64, device=ends.device)
    gaussians = torch.empty(2 * room, dtype=torch.int32, device=ends.device)
    if not len(depths):
        keys[:room], gaussians[:room] = columns * rows << kernels.DEPTH_BITS, 0
    elif room:
        touched = None, shapes, ellipses, extents, depths, columns, rows
        launch(tile_kernels(wp.float32).emit_keys, len(depths), *touched, ends, room, keys, gaussians, overflow)
    return keys, gaussians


def lists_by_tile(tiles, gaussians, intersection_count: int, records, columns: int, rows: int, unsorted: bool):
    """A stable sort of emit_intersections()'s by tile: the tiles' ranges and Gaussians [M]; corners [M], or None on the
    CPU and without records; where each entry stood before [M], or None. Ranges and corners are find_lists()'s."""
    if tiles.device.type == "cpu":
        ranges, gaussians, places = _count_by_tile(tiles, gaussians, intersection_count, columns * rows, unsorted)
        return ranges, gaussians, None, places
    return _sort_by_tile(tiles, gaussians, intersection_count, records, columns, rows, unsorted)


def _sort_by_tile(tiles, gaussians, intersection_count: int, records, columns: int, rows: int, unsorted: bool):
    bits, places = (columns * rows).bit_length(), None
    if unsorted:
        places = torch.empty(2 * intersection_count, dtype=torch.int32, device=tiles.device)
        torch.arange(intersection_count, dtype=torch.int32, device=tiles.device, out=places[:intersection_count])
    _sort_pairs(tiles, gaussians if places is None else places, intersection_count, bits)
    if places is None:
        gaussians = gaussians[:intersection_count].clone()
    else:
        places = places[:intersection_count].clone()
        gaussians = gaussians[:intersection_count][places] if intersection_count else gaussians
    ranges, corners = find_lists(tiles[:intersection_count], gaussians, records, columns, rows)
    return ranges, gaussians, corners, places


def _count_by_tile(tiles, gaussians, intersection_count: int, tile_count: int, unsorted: bool):
    """By counting, each thread a few chunks of the intersections: within a tile those of the first chunk come first."""
    tiles, gaussians = tiles[:intersection_count], gaussians[:intersection_count]
    chunks = max(1, min(2 * thread_count(), intersection_count // SMALLEST_CHUNK))
    counts = torch.zeros(chunks, tile_count + 1, dtype=torch.int32)
    size, spans = -(-intersection_count // chunks), torch.arange(chunks + 1, dtype=torch.int32)
    launch(kernels.count_tiles, chunks, tiles, size, counts, ranges=spans)
    by_tile = counts.t().reshape(-1)
    starts = (by_tile.cumsum(0) - by_tile).int().view(tile_count + 1, chunks).t().contiguous()
    ranges = torch.stack([starts[0, :-1], starts[0, 1:]], 1)
    sorted_ones = torch.empty_like(gaussians)
    places = torch.empty(intersection_count if unsorted else 0, dtype=torch.int32)
    launch(kernels.place_intersections, chunks, tiles, gaussians, size, starts, sorted_ones, places, ranges=spans)
    return ranges, sorted_ones, places if unsorted else None


def _taken(values: Tensor, places: Tensor) -> Tensor:
    with torch_threads(values.device):
        return values[places]


def sort_keys(keys, gaussians, intersection_count: int, tile_count: int):
    """Stable sort of emit_keys()'s by tile and depth: keys [M] and Gaussians [M], in the same memory."""
    _sort_pairs(keys, gaussians, intersection_count, kernels.DEPTH_BITS + tile_count.bit_length())
    return keys[:intersection_count], gaussians[:intersection_count]


def find_lists(tiles, gaussians, records, columns: int, rows: int):
    """[tiles, 2] int32, first and one past the last of each tile in the sorted list, alike for none; and [M] uint8, the
    corners of its tile that each entry touches, or None without records. tiles: int32, or int64 as sort_keys() gives
    them."""
    ranges = torch.empty(columns * rows, 2, dtype=torch.int32, device=tiles.device)
    corners = torch.empty(0 if records is None else len(tiles), dtype=torch.uint8, device=tiles.device)
    if len(tiles):
        kind = (wp.int64, kernels.DEPTH_BITS) if tiles.dtype == torch.int64 else (wp.int32, 0)
        read = (torch.empty(0, 4, device=tiles.device),) * 2 if records is None else records
        kernel = kernels.lists_kernel(warp_scalar(read[0].dtype), *kind)
        launch(kernel, len(tiles), tiles, gaussians, *read, columns, columns * rows, ranges.view(-1), corners)
    else:
        ranges.zero_()
    return ranges, None if records is None else corners


class _Memory:
    """What radix_sort_pairs() reads of an array; a tenth of what a wp.array costs the host."""

    is_contiguous = True

    def __init__(self, tensor: Tensor) -> None:
        self.ptr, self.size = tensor.data_ptr(), tensor.numel()
        self.dtype, self.device = wp.dtype_from_torch(tensor.dtype), wp.device_from_torch(tensor.device)


def _sort_pairs(keys, values, count: int, bits: int | None) -> None:
    """Sorts keys[:count] and values[:count] by the keys' lowest bits (stable); both have room for 2 count."""
    if count:
        with torch_stream(keys.device):
            wp.utils.radix_sort_pairs(_Memory(keys), _Memory(values), count, end_bit=bits)  # pyright: ignore[reportArgumentType]
