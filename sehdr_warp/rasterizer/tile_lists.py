"""The middle stages of a render: pack splats, order them by depth, and list for each tile those that touch it.

An *intersection* is a pair of a Gaussian and a tile that it touches. They are emitted Gaussian by Gaussian, then sorted
by tile.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from ..errors import SehdrError
from ..kernels import tiles as kernels
from ..kernels.blend_cuda import padded_channels
from ..kernels.constants import TILE_SIZE
from ..parallel import thread_count
from .projection import ProjectedGaussians, Splats2D
from .render_options import MAX_INTERSECTIONS
from .warp_launch.launching import FixedLaunch, fixed_launch, launch, sort_pairs, warp_scalar
from .warp_launch.threads import torch_threads

MAX_SINGLE_SORT = 1 << 18
"""Up to this many Gaussians a GPU makes the lists by one sort: the host is then the bottleneck, not memory."""
MIN_CHUNK = 1 << 14  # Intersections that are worth a thread's time.


class PackedSplats(NamedTuple):
    """Values of each splat that the lists and blending read; those of blending in rows of four."""

    means_opacities: Tensor  # [N, 4] x, y, opacity, half-height
    conics_cutoffs: Tensor  # [N, 4] conic a, b, c; a dx^2 + 2 b dx dy + c dy^2 at the threshold, -1 if culled
    counts: Tensor  # [N] int64 tiles that the ellipse touches
    depths: Tensor  # [N] as of Splats2D
    extents: Tensor  # [N, 2] as of Splats2D
    padded: Tensor | None = None  # [N, columns] features in whole rows of four for block kernels; None if unread


class TileGrid(NamedTuple):
    """Tiles across and down an image."""

    columns: int
    rows: int

    @property
    def tiles(self) -> int:
        """Return the number of tiles, which unused intersections have for their tile."""
        return self.columns * self.rows


def tile_grid(width: int, height: int) -> TileGrid:
    """Return how many tiles cover an image of `width` x `height` pixels."""
    return TileGrid(-(-width // TILE_SIZE), -(-height // TILE_SIZE))


class EmitOrder(NamedTuple):
    """The order in which Gaussians emit intersections, those of one Gaussian as neighbors, and where each one's end.

    Attributes:
        order: [N] int32 Gaussians by depth, nearest first (ties by index; culled ones last); None for the order of
            their indices, after which the sort by tile also sorts by depth.
        cumulative_counts: [N] int64 inclusive prefix sum of the Gaussians' intersection counts, in that order.
    """

    order: Tensor | None
    cumulative_counts: Tensor


@dataclass(frozen=True)
class TileLists:
    """Gaussians that touch each tile, front to back. All indices are int32."""

    tile_ranges: Tensor  # [tiles, 2] first intersection of each tile and one past its last
    gaussians: Tensor  # [M] the Gaussian of each intersection
    subtile_masks: Tensor | None  # [M] uint8, bit k: the ellipse touches subtile k; None if no kernel reads it
    emit_order: EmitOrder | None  # Before the sort, for sum_by_gaussian(); None unless it was to be kept
    emit_indices: Tensor | None  # [M] index of each intersection in that order; None without it
    width: int  # Of the image in pixels
    height: int  # Of the image in pixels
    overflow: Tensor | None  # Scalar bool, whether max_intersections was too few; None without it
    total: Tensor  # Scalar int64, how many intersections there are, listed or not

    @property
    def grid(self) -> TileGrid:
        """Return the tiles of the image."""
        return tile_grid(self.width, self.height)

    @property
    def intersection_count(self) -> int:
        """Return how many intersections memory was allocated for: all there are, or max_intersections."""
        return self.gaussians.shape[0]


def pack_splats(
    splats: Splats2D, alpha_threshold: float, width: int, height: int, *, pads: bool | None = None
) -> PackedSplats:
    """Pack splats for an image, and count the tiles that each one's ellipse touches.

    Culls those whose features are not finite: sets their rows of splats.extents to 0 in place.

    pads: whether to make PackedSplats.padded; by default on a GPU, if the channels are not a multiple of four.
    """
    features = splats.features
    count, channels = features.shape
    if pads is None:
        pads = features.device.type == "cuda" and channels % 4 > 0
    packed = PackedSplats(
        features.new_empty(count, 4),
        features.new_empty(count, 4),
        torch.empty(count, dtype=torch.int64, device=features.device),
        splats.depths,
        splats.extents,
        features.new_empty(count, padded_channels(channels)) if pads else None,
    )
    kernel = kernels.tile_kernels(warp_scalar(features.dtype)).pack_splats
    launch(kernel, count, *_pack_arguments(splats, packed, alpha_threshold, width, height))
    return packed


def fixed_pack_splats(
    splats: Splats2D, packed: PackedSplats, alpha_threshold: float, width: int, height: int
) -> FixedLaunch:
    """Return the launch that fills `packed` anew, whose tensors stay where they are but for the features."""
    kernel = kernels.tile_kernels(warp_scalar(splats.features.dtype)).pack_splats
    arguments = _pack_arguments(splats, packed, alpha_threshold, width, height)
    return fixed_launch(kernel, len(splats.features), *arguments, by_address=(splats.features,))


def _pack_arguments(
    splats: Splats2D, packed: PackedSplats, alpha_threshold: float, width: int, height: int
) -> tuple[Any, ...]:
    means2d, conics, _, opacities, extents, features = splats
    padded = None if packed.padded is None else packed.padded.view(-1, 4)
    return (
        *(means2d, conics, opacities, features, features.shape[1], alpha_threshold, *tile_grid(width, height)),
        *(extents, packed.means_opacities, packed.conics_cutoffs, packed.counts, padded),
    )


@torch.no_grad()
def order_gaussians(packed: PackedSplats, *, keep_emit_order: bool = True) -> EmitOrder:
    """Order Gaussians by depth, as they emit intersections.

    keep_emit_order: whether build_tile_lists() is to keep the order. Without it few Gaussians are not sorted, because
        the sort of their intersections also sorts by depth.
    """
    counts, depths = packed.counts, packed.depths
    if len(depths) <= MAX_SINGLE_SORT and not keep_emit_order and depths.dtype == torch.float32:
        return EmitOrder(None, counts.cumsum(0))
    order = depth_order(depths, packed.extents)
    with torch_threads(counts.device):
        counts = counts[order]
    return EmitOrder(order, counts.cumsum(0))


@torch.no_grad()
def build_tile_lists(
    packed: PackedSplats,
    emit_order: EmitOrder,
    width: int,
    height: int,
    max_intersections: int | None = None,
    *,
    keep_emit_order: bool = False,
) -> TileLists:
    """List for each tile of an image the Gaussians whose ellipse touches it, nearest first.

    max_intersections: allocate memory for this many; those beyond it are left out, see TileLists.overflow. The host
        then does not wait for the device to learn how many there are.
    keep_emit_order: return TileLists.emit_order, which must be by depth.

    Raises SehdrError if there are more than MAX_INTERSECTIONS.
    """
    grid, count = tile_grid(width, height), len(packed.depths)
    order, cumulative_counts = emit_order
    total = cumulative_counts[-1] if count else cumulative_counts.new_zeros(())
    overflow = None
    if max_intersections is not None:  # Written by the kernel that emits, if it is launched, which saves a launch.
        overflow = (torch.empty if count else torch.zeros)((), dtype=torch.bool, device=cumulative_counts.device)
    length = int(total) if max_intersections is None else max_intersections
    check_intersection_count(length, count, grid)
    keys, gaussians = emit_intersections(packed, emit_order, grid, length, overflow)
    if order is None:
        sort_pairs(keys, gaussians, length, kernels.DEPTH_BITS + grid.tiles.bit_length())
        gaussians = gaussians[:length]
        tile_ranges, subtile_masks = find_tile_ranges(keys[:length], gaussians, packed, grid)
        return TileLists(tile_ranges, gaussians, subtile_masks, None, None, width, height, overflow, total)
    tile_ranges, gaussians, subtile_masks, emit_indices = lists_by_tile(
        keys, gaussians, length, packed, grid, keep_emit_order
    )
    # Copies, because order and total are views that would keep larger buffers.
    order_copy = EmitOrder(order.clone(), cumulative_counts) if keep_emit_order else None
    lists = tile_ranges, gaussians, subtile_masks, order_copy, emit_indices
    return TileLists(*lists, width, height, overflow, total.clone())


@torch.no_grad()
def depths_along(axis: Tensor, projected: ProjectedGaussians, intrinsics: Tensor) -> Tensor:
    """Return depths [N] of Gaussians along an axis [3] of the camera's coordinates, at least a thousandth of theirs."""
    inputs = tuple(tensor.contiguous() for tensor in (projected.means2d, projected.depths, intrinsics, axis))
    along = torch.empty_like(projected.depths)
    launch(kernels.tile_kernels(warp_scalar(along.dtype)).turn_depths, len(along), *inputs, along)
    return along


def depth_order(depths: Tensor, extents: Tensor) -> Tensor:
    """Return [N] int32: Gaussians nearest first, culled ones last; equal depths keep the order of their indices.

    It is a view of the memory that the sort needed, which is twice as large.
    """
    count = depths.shape[0]
    keys = depths.new_empty(2 * count)
    indices = torch.empty(2 * count, dtype=torch.int32, device=depths.device)
    launch(kernels.tile_kernels(warp_scalar(depths.dtype)).key_by_depth, count, depths, extents, keys, indices)
    sort_pairs(keys, indices, count)
    return indices[:count]


def check_intersection_count(length: int, count: int, grid: TileGrid) -> None:
    """Raise SehdrError if there are too many intersections to be counted in int32."""
    if length > MAX_INTERSECTIONS:
        raise SehdrError(
            f"{count} Gaussians touch {length} tiles of a {grid.columns} x {grid.rows} tile image, more than 2^31 - 1; "
            "render fewer Gaussians or a smaller image"
        )


def emit_intersections(
    packed: PackedSplats, emit_order: EmitOrder, grid: TileGrid, length: int, overflow: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return sort keys and Gaussians of all intersections.

    If Gaussians emit by depth, the keys are int32 tiles, and intersections follow that order. Otherwise the keys are
    int64, the tile above the bits of the depth, and intersections follow the Gaussians' indices.

    Both are [2 * length], of which the first half is filled; the sort needs the rest. Unused intersections belong to
    tile grid.tiles. Writes to overflow, a scalar bool, whether there are more than `length`.
    """
    order, cumulative_counts = emit_order
    count, device = len(packed.depths), packed.depths.device
    keys = torch.empty(2 * length, dtype=torch.int64 if order is None else torch.int32, device=device)
    gaussians = torch.empty(2 * length, dtype=torch.int32, device=device)
    if not count:
        keys[:length], gaussians[:length] = grid.tiles << (kernels.DEPTH_BITS if order is None else 0), 0
    elif length:
        emit = kernels.tile_kernels(warp_scalar(packed.means_opacities.dtype))
        kernel, depths = (emit.emit_by_index, packed.depths) if order is None else (emit.emit_by_depth, None)
        inputs = order, packed.means_opacities, packed.conics_cutoffs, packed.extents, depths, *grid
        launch(kernel, count, *inputs, cumulative_counts, length, keys, gaussians, overflow)
    return keys, gaussians


def lists_by_tile(
    tiles: Tensor, gaussians: Tensor, length: int, packed: PackedSplats | None, grid: TileGrid, keep_emit_order: bool
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    """Sort intersections, emitted front to back, by tile, stably.

    Returns TileLists.tile_ranges, gaussians, subtile_masks (None on the CPU and without packed Gaussians, as for
    rasterize_directions()) and emit_indices (None unless keep_emit_order).
    """
    sort = count_by_tile if tiles.device.type == "cpu" else sort_by_tile
    return sort(tiles, gaussians, length, packed, grid, keep_emit_order)


def sort_by_tile(tiles, gaussians, length, packed, grid, keep_emit_order):
    """Sort by a radix sort, best on GPUs."""
    emit_indices = None
    if keep_emit_order:
        emit_indices = torch.empty(2 * length, dtype=torch.int32, device=tiles.device)
        torch.arange(length, dtype=torch.int32, device=tiles.device, out=emit_indices[:length])
    sort_pairs(tiles, gaussians if emit_indices is None else emit_indices, length, grid.tiles.bit_length())
    if emit_indices is None:
        gaussians = gaussians[:length].clone()
    else:
        emit_indices = emit_indices[:length].clone()
        gaussians = gaussians[:length][emit_indices] if length else gaussians
    tile_ranges, subtile_masks = find_tile_ranges(tiles[:length], gaussians, packed, grid)
    return tile_ranges, gaussians, subtile_masks, emit_indices


def count_by_tile(tiles, gaussians, length, packed, grid, keep_emit_order):
    """Sort by counting, best on CPUs: each thread takes a few chunks, and within a tile the first chunk comes first."""
    tiles, gaussians = tiles[:length], gaussians[:length]
    chunks = max(1, min(2 * thread_count(), length // MIN_CHUNK))
    counts = torch.zeros(chunks, grid.tiles + 1, dtype=torch.int32, device=tiles.device)
    size = -(-length // chunks)
    spans = torch.arange(chunks + 1, dtype=torch.int32, device=tiles.device)
    launch(kernels.count_tiles, chunks, tiles, size, counts, ranges=spans)
    by_tile = counts.t().reshape(-1)
    starts = (by_tile.cumsum(0) - by_tile).int().view(grid.tiles + 1, chunks).t().contiguous()
    tile_ranges = torch.stack([starts[0, :-1], starts[0, 1:]], 1)
    ordered = torch.empty_like(gaussians)
    emit_indices = torch.empty_like(gaussians) if keep_emit_order else None
    launch(kernels.place_intersections, chunks, tiles, gaussians, size, starts, ordered, emit_indices, ranges=spans)
    return tile_ranges, ordered, None, emit_indices


def find_tile_ranges(
    keys: Tensor, gaussians: Tensor, packed: PackedSplats | None, grid: TileGrid
) -> tuple[Tensor, Tensor | None]:
    """Return the tile_ranges [tiles, 2] and subtile_masks [M] of sorted intersections, as TileLists has them.

    Both numbers of an empty range are equal. subtile_masks are None without packed Gaussians, as for the caps of
    rasterize_directions(). keys: of emit_intersections(), sorted.
    """
    tile_ranges = (torch.empty if len(keys) else torch.zeros)(grid.tiles, 2, dtype=torch.int32, device=keys.device)
    subtile_masks = None if packed is None else torch.empty(len(keys), dtype=torch.uint8, device=keys.device)
    if len(keys):
        key_type = (wp.int64, kernels.DEPTH_BITS) if keys.dtype == torch.int64 else (wp.int32, 0)
        scalar = wp.float32 if packed is None else warp_scalar(packed.means_opacities.dtype)
        ellipses = (None, None) if packed is None else packed[:2]
        inputs = keys, gaussians, *ellipses, grid.columns, grid.tiles
        launch(kernels.tile_ranges_kernel(scalar, *key_type), len(keys), *inputs, tile_ranges.view(-1), subtile_masks)
    return tile_ranges, subtile_masks
