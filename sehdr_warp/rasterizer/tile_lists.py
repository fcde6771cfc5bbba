"""The middle stages of a render: pack 2D Gaussians, order them by depth, and list for each tile those that touch it."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from ..errors import SehdrError
from ..kernels import tiles as kernels
from ..kernels.constants import TILE_SIZE
from ..kernels.tiles import tile_kernels
from ..parallel import thread_count
from .warp_launch.launching import launch, warp_scalar
from .warp_launch.sorting import sort_pairs
from .warp_launch.threads import torch_threads

MAX_INTERSECTIONS = 2**31 - 1  # They are counted in int32.
ONE_SORT = 1 << 18
"""Up to this many Gaussians a GPU makes the lists by one sort: the host is then the bottleneck, not memory."""
MIN_CHUNK = 1 << 14  # Intersections that are worth a thread's time.


class Splats(NamedTuple):
    """2D Gaussians and their features as kernels read them, contiguous and without a graph.

    Attributes:
        means2d: [N, 2] centres in pixels.
        conics: [N, 3] a, b, c of the inverse covariance.
        opacities: [N].
        features: [N, C].
        depths: [N].
        extents: [N, 2] half-width and half-height in pixels; 0 if culled.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    features: Tensor
    depths: Tensor
    extents: Tensor


class PackedSplats(NamedTuple):
    """Values of each 2D Gaussian that blending reads, in rows of four, and its number of tiles.

    Attributes:
        shapes: [N, 4] x, y, opacity, half-height.
        ellipses: [N, 4] conic a, b, c and the level at which alpha meets the threshold; -1 if culled.
        counts: [N] int64 tiles that the ellipse touches.
    """

    shapes: Tensor
    ellipses: Tensor
    counts: Tensor


class IntersectionOffsets(NamedTuple):
    """The order in which Gaussians emit intersections, and where each one's end.

    Attributes:
        order: [N] int32 Gaussians by depth; None if they emit in the order of their indices.
        ends: [N] int64 running number of intersections, by place in the order.
    """

    order: Tensor | None
    ends: Tensor


@dataclass(frozen=True)
class UnsortedIntersections:
    """Positions of intersections before the sort by tile, those of one Gaussian next to each other.

    Attributes:
        order: [N] int32 Gaussians by depth, nearest first (ties by index; culled ones last).
        ends: [N] int64 running number of intersections, by place in `order`.
        places: [M] int32 place of each sorted intersection before the sort.
    """

    order: Tensor
    ends: Tensor
    places: Tensor


@dataclass(frozen=True)
class TileLists:
    """For each tile the Gaussians that touch it, front to back. All indices are int32.

    Attributes:
        ranges: [tiles, 2] first intersection of each tile and one past its last.
        gaussians: [M] the Gaussian of each intersection.
        corners: [M] uint8, bit k set if the ellipse touches corner k of its tile; None on the CPU.
        unsorted: how intersections stood by Gaussian; None unless requested.
        width: of the image in pixels.
        height: of the image in pixels.
        overflow: scalar bool, whether max_intersections was too few; None without it.
        total: scalar int64, how many intersections there are, listed or not.
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
        """Tiles across."""
        return -(-self.width // TILE_SIZE)

    @property
    def rows(self) -> int:
        """Tiles down."""
        return -(-self.height // TILE_SIZE)

    @property
    def intersection_count(self) -> int:
        """Intersections that memory was allocated for: all there are, or max_intersections."""
        return self.gaussians.shape[0]


def pack_splats(splats: Splats, alpha_threshold: float, width: int, height: int) -> PackedSplats:
    """Pack 2D Gaussians for an image, and count the tiles that each one's ellipse touches.

    Culls Gaussians whose features are not finite: sets their rows of splats.extents to 0 in place.
    """
    means2d, features = splats.means2d, splats.features
    count = len(means2d)
    packed = PackedSplats(
        means2d.new_empty(count, 4),
        means2d.new_empty(count, 4),
        torch.empty(count, dtype=torch.int64, device=means2d.device),
    )
    launch(
        tile_kernels(warp_scalar(means2d.dtype)).pack_splats,
        count,
        means2d,
        splats.conics,
        splats.opacities,
        features,
        features.shape[1],
        alpha_threshold,
        -(-width // TILE_SIZE),
        -(-height // TILE_SIZE),
        splats.extents,
        *packed,
    )
    return packed


@torch.no_grad()
def order_intersections(
    counts: Tensor, depths: Tensor, extents: Tensor, *, unsorted: bool = True
) -> IntersectionOffsets:
    """Return the order in which Gaussians emit intersections, by depth, and the running number of these.

    Args:
        counts: [N] of PackedSplats.
        depths: [N].
        extents: [N, 2]; 0 if culled.
        unsorted: as build_tile_lists() gets it.
    """
    one_sort = len(depths) <= ONE_SORT and not unsorted and depths.dtype == torch.float32
    if one_sort:
        return IntersectionOffsets(None, counts.cumsum(0))
    order = depth_order(depths, extents)
    with torch_threads(counts.device):
        counts = counts[order]
    return IntersectionOffsets(order, counts.cumsum(0))


@torch.no_grad()
def build_tile_lists(
    packed: PackedSplats,
    offsets: IntersectionOffsets,
    depths: Tensor,
    extents: Tensor,
    width: int,
    height: int,
    max_intersections: int | None = None,
    *,
    unsorted: bool = True,
) -> TileLists:
    """List for each tile the Gaussians whose ellipse touches it, nearest first.

    Args:
        packed: of the Gaussians, for an image of this size.
        offsets: of order_intersections().
        depths: [N].
        extents: [N, 2].
        width: of the image, pixels.
        height: of the image, pixels.
        max_intersections: allocate memory for this many; those beyond it are left out, see TileLists.overflow. The host
            then does not wait for the device to learn how many there are.
        unsorted: also return TileLists.unsorted, which adjoints need that sum by Gaussian in a fixed order.

    Raises:
        SehdrError: if there are more than MAX_INTERSECTIONS.
    """
    columns, rows = -(-width // TILE_SIZE), -(-height // TILE_SIZE)
    order, ends = offsets
    count = len(depths)
    total = ends[-1] if count else ends.new_zeros(())
    overflow = None
    if max_intersections is not None:  # Written by the kernel that emits, if it is launched: a comparison is a launch.
        overflow = (torch.empty if count else torch.zeros)((), dtype=torch.bool, device=ends.device)
    length = check_intersection_count(
        int(total) if max_intersections is None else max_intersections, count, columns, rows
    )
    if order is None:
        keys, gaussians = emit_keys(packed, extents, depths, columns, rows, ends, length, overflow)
        keys, gaussians = sort_keys(keys, gaussians, length, columns * rows)
        ranges, corners = find_lists(keys, gaussians, packed, columns, rows)
        return TileLists(ranges, gaussians, corners, None, width, height, overflow, total)
    tiles, gaussians = emit_intersections(order, packed, extents, columns, rows, ends, length, overflow)
    ranges, gaussians, corners, places = lists_by_tile(tiles, gaussians, length, packed, columns, rows, unsorted)
    before = None if places is None else UnsortedIntersections(order.clone(), ends, places)
    return TileLists(ranges, gaussians, corners, before, width, height, overflow, total.clone())


def depth_order(depths: Tensor, extents: Tensor) -> Tensor:
    """Return [N] int32: Gaussians nearest first, culled ones last; equal depths keep the order of their indices.

    It is a view of the memory that the sort needed, which is twice as large.
    """
    count = depths.shape[0]
    keys = depths.new_empty(2 * count)
    places = torch.empty(2 * count, dtype=torch.int32, device=depths.device)
    launch(tile_kernels(warp_scalar(depths.dtype)).key_by_depth, count, depths, extents, keys, places)
    sort_pairs(keys, places, count)
    return places[:count]


def check_intersection_count(length: int, count: int, columns: int, rows: int) -> int:
    """Return the number of intersections; raise SehdrError if there are too many to be counted in int32."""
    if length > MAX_INTERSECTIONS:
        raise SehdrError(
            f"{count} Gaussians touch {length} tiles of a {columns} x {rows} tile image, more than 2^31 - 1; "
            "render fewer Gaussians or a smaller image"
        )
    return length


def emit_intersections(
    order: Tensor,
    packed: PackedSplats,
    extents: Tensor,
    columns: int,
    rows: int,
    ends: Tensor,
    length: int,
    overflow: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return tiles and Gaussians of all intersections, front to back.

    Both are [2 * length], of which the first half is filled; the sort needs the rest. Unused intersections belong to
    tile columns * rows. Writes to overflow, a scalar bool, whether there are more than `length`.
    """
    tiles, gaussians = (torch.empty(2 * length, dtype=torch.int32, device=order.device) for _ in range(2))
    if not len(order):
        tiles[:length], gaussians[:length] = columns * rows, 0
    elif length:
        kernel = tile_kernels(warp_scalar(packed.shapes.dtype)).emit_intersections
        shapes, ellipses = packed.shapes, packed.ellipses
        frame = columns, rows, ends, length
        launch(kernel, len(order), order, shapes, ellipses, extents, None, *frame, tiles, gaussians, overflow)
    return tiles, gaussians


def emit_keys(
    packed: PackedSplats,
    extents: Tensor,
    depths: Tensor,
    columns: int,
    rows: int,
    ends: Tensor,
    length: int,
    overflow: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return int64 keys, the tile above the bits of the depth, and Gaussians of all intersections, by Gaussian.

    Otherwise as emit_intersections().
    """
    keys = torch.empty(2 * length, dtype=torch.int64, device=ends.device)
    gaussians = torch.empty(2 * length, dtype=torch.int32, device=ends.device)
    if not len(depths):
        keys[:length], gaussians[:length] = columns * rows << kernels.DEPTH_BITS, 0
    elif length:
        kernel, frame = tile_kernels(wp.float32).emit_keys, (columns, rows, ends, length)
        shapes, ellipses = packed.shapes, packed.ellipses
        launch(kernel, len(depths), None, shapes, ellipses, extents, depths, *frame, keys, gaussians, overflow)
    return keys, gaussians


class SortedLists(NamedTuple):
    """Intersections sorted by tile; see TileLists and UnsortedIntersections."""

    ranges: Tensor
    gaussians: Tensor
    corners: Tensor | None
    places: Tensor | None


def lists_by_tile(
    tiles: Tensor,
    gaussians: Tensor,
    length: int,
    packed: PackedSplats | None,
    columns: int,
    rows: int,
    unsorted: bool,
) -> SortedLists:
    """Sort emit_intersections()'s by tile, stably; places are None unless `unsorted`.

    Corners are None on the CPU and without packed Gaussians.
    """
    if tiles.device.type == "cpu":
        return _count_by_tile(tiles, gaussians, length, columns * rows, unsorted)
    return _sort_by_tile(tiles, gaussians, length, packed, columns, rows, unsorted)


def _sort_by_tile(tiles, gaussians, length: int, packed, columns: int, rows: int, unsorted: bool) -> SortedLists:
    bits, places = (columns * rows).bit_length(), None
    if unsorted:
        places = torch.empty(2 * length, dtype=torch.int32, device=tiles.device)
        torch.arange(length, dtype=torch.int32, device=tiles.device, out=places[:length])
    sort_pairs(tiles, gaussians if places is None else places, length, bits)
    if places is None:
        gaussians = gaussians[:length].clone()
    else:
        places = places[:length].clone()
        gaussians = gaussians[:length][places] if length else gaussians
    ranges, corners = find_lists(tiles[:length], gaussians, packed, columns, rows)
    return SortedLists(ranges, gaussians, corners, places)


def _count_by_tile(tiles, gaussians, length: int, tile_count: int, unsorted: bool) -> SortedLists:
    """Sort by counting: each thread takes a few chunks, and within a tile those of the first chunk come first."""
    tiles, gaussians = tiles[:length], gaussians[:length]
    chunks = max(1, min(2 * thread_count(), length // MIN_CHUNK))
    counts = torch.zeros(chunks, tile_count + 1, dtype=torch.int32)
    size, spans = -(-length // chunks), torch.arange(chunks + 1, dtype=torch.int32)
    launch(kernels.count_tiles, chunks, tiles, size, counts, ranges=spans)
    by_tile = counts.t().reshape(-1)
    starts = (by_tile.cumsum(0) - by_tile).int().view(tile_count + 1, chunks).t().contiguous()
    ranges = torch.stack([starts[0, :-1], starts[0, 1:]], 1)
    ordered = torch.empty_like(gaussians)
    places = torch.empty(length if unsorted else 0, dtype=torch.int32)
    launch(kernels.place_intersections, chunks, tiles, gaussians, size, starts, ordered, places, ranges=spans)
    return SortedLists(ranges, ordered, None, places if unsorted else None)


def sort_keys(keys: Tensor, gaussians: Tensor, length: int, tile_count: int) -> tuple[Tensor, Tensor]:
    """Sort emit_keys()'s by tile and depth, stably; return keys [M] and Gaussians [M] in the same memory."""
    sort_pairs(keys, gaussians, length, kernels.DEPTH_BITS + tile_count.bit_length())
    return keys[:length], gaussians[:length]


def find_lists(
    tiles: Tensor, gaussians: Tensor, packed: PackedSplats | None, columns: int, rows: int
) -> tuple[Tensor, Tensor | None]:
    """Return the tiles' ranges [tiles, 2] and the corners [M] of sorted intersections, as TileLists has them.

    The ends of an empty range are equal. Corners are None without packed Gaussians. tiles: int32, or the int64 keys of
    sort_keys().
    """
    ranges = torch.empty(columns * rows, 2, dtype=torch.int32, device=tiles.device)
    corners = torch.empty(0 if packed is None else len(tiles), dtype=torch.uint8, device=tiles.device)
    if len(tiles):
        kind = (wp.int64, kernels.DEPTH_BITS) if tiles.dtype == torch.int64 else (wp.int32, 0)
        if packed is None:
            shapes = ellipses = torch.empty(0, 4, device=tiles.device)
        else:
            shapes, ellipses = packed.shapes, packed.ellipses
        kernel = kernels.lists_kernel(warp_scalar(shapes.dtype), *kind)
        tile_count = columns * rows
        launch(kernel, len(tiles), tiles, gaussians, shapes, ellipses, columns, tile_count, ranges.view(-1), corners)
    else:
        ranges.zero_()
    return ranges, None if packed is None else corners
