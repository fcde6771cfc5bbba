"""The last stage of a render: blend the tile lists front to back, any number of channels in one pass."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import blend_cpu, blend_cuda, blend_cuda_adjoint
from ..kernels.constants import TILE_SIZE
from ..kernels.tiles import tile_kernels
from ..parallel import thread_count
from .tile_lists import ONE_SORT, TileLists, UnsortedIntersections
from .warp_launch.launching import launch, warp_scalar

PIECES_PER_THREAD = 16
"""Of the image, on the CPU: some take longer than their intersections tell."""
Adjoint = Callable[[Tensor, Tensor | None], Tensor]
"""The backward pass: from the gradients by image and transmittance (None for 0) to those by Gaussian, [N, C + 6 or
more]: features, conic a b c, x, y, opacity, and what fills up a row."""


class BlendResult(NamedTuple):
    """image [H, W, C], transmittance [H, W], and how to differentiate them; with no graph behind them."""

    image: Tensor
    transmittance: Tensor
    adjoint: Adjoint


def blend(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    features: Tensor,
    lists: TileLists,
    records: tuple[Tensor, Tensor],
    alpha_threshold: float,
    deterministic: bool = False,
) -> tuple[Tensor, Tensor]:
    """Blend features [N, C] over the tile lists: image [H, W, C] and the transmittance left [H, W].

    Differentiable once with respect to means2d [N, 2], conics [N, 3], opacities [N] and features. Which intersections
    count is decided by the lists and by alpha_threshold, and taken as given in the derivative.

    records: pack_gaussians()'s of these means2d, conics and opacities, and of alpha_threshold.
    deterministic: on a GPU gradients are summed in a fixed order, as the CPU always does: slower, and the gradients of
    every (Gaussian, tile) pair take memory.
    """
    rows = features.detach()
    image = rows.new_empty(lists.height, lists.width, rows.shape[1])
    transmittance = rows.new_empty(image.shape[:2])
    backend = blend_on_cuda if rows.device.type == "cuda" else blend_on_cpu
    # The adjoint keeps one of them, and must not keep what torch makes a result of: it would keep itself.
    given = rows, lists, records, image.detach(), transmittance.detach(), alpha_threshold, deterministic
    return with_gradient(means2d, conics, opacities, features, BlendResult(image, transmittance, backend(*given)))


def with_gradient(means2d, conics, opacities, features, picture: BlendResult) -> tuple[Tensor, Tensor]:
    """A picture's image and transmittance, as functions of what it was drawn from."""
    return _Blend.apply(means2d, conics, opacities, features, picture)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, opacities, features, picture: BlendResult):
        ctx.sizes, ctx.adjoint = picture.image.shape, picture.adjoint
        ctx.set_materialize_grads(False)
        return picture.image, picture.transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_image, by_transmittance):
        adjoint, ctx.adjoint = ctx.adjoint, None
        if adjoint is None:
            raise RuntimeError("this blend was already differentiated once; run its forward pass again")
        if by_image is None and by_transmittance is None:
            return (None,) * 5
        _, width, channels = ctx.sizes
        by_image = by_transmittance.new_zeros(ctx.sizes) if by_image is None else by_image.contiguous()
        # Of an axis of length 1 torch calls any stride contiguous, and kernels do not.
        if by_image.stride() != (width * channels, channels, 1):
            by_image = by_image.as_strided(ctx.sizes, (width * channels, channels, 1))
        gathered = adjoint(by_image, None if by_transmittance is None else by_transmittance.contiguous())
        rest = gathered.shape[1] - channels - 6
        by_features, by_conics, by_means2d, by_opacities, _ = gathered.split_with_sizes((channels, 3, 2, 1, rest), 1)
        gradients = by_means2d, by_conics, by_opacities[:, 0], by_features
        return *(part if needed else None for part, needed in zip(gradients, ctx.needs_input_grad, strict=False)), None


def blend_on_cpu(
    features, lists: TileLists, records, image, left_over, alpha_threshold: float, deterministic: bool
) -> Adjoint:
    """Fill image [H, W, C] and left_over [H, W], the transmittance: balanced pieces of tiles, a thread each."""
    scalar, unsorted = warp_scalar(features.dtype), lists.unsorted
    assert unsorted is not None, "sums in a fixed order need the intersections as they were emitted"
    height, width, channels = image.shape
    kind = scalar, channels, halvings(alpha_threshold)
    tile_count, pieces = lists.columns * lists.rows, balanced_pieces(lists)

    def rows(*shape):
        return features.new_empty(tile_count, *shape, blend_cpu.LANES)

    iota, count = torch.arange(blend_cpu.LANES, dtype=features.dtype), blend_cpu.HALVES * TILE_SIZE
    frame = features, lists.columns, width, height, alpha_threshold, iota
    transmittance, last = rows(count), rows(count)
    launch(
        blend_cpu.forward_kernel(*kind),
        tile_count,
        *(lists.ranges, lists.gaussians, *records, *frame),
        *(transmittance, rows(channels, count), last, image.view(-1, channels), left_over),
        ranges=pieces,
    )

    def backward(image_gradient: Tensor, left_over_gradient: Tensor | None) -> Tensor:
        if left_over_gradient is None:
            left_over_gradient = torch.zeros_like(left_over)
        scratch = rows(count), rows(channels, count), rows(TILE_SIZE), rows(TILE_SIZE), rows(channels + 6)
        intersection_gradients = features.new_empty(lists.intersection_count, channels + 6)
        launch(
            blend_cpu.backward_kernel(*kind),
            tile_count,
            *(lists.ranges, lists.gaussians, unsorted.places, *records, *frame, last),
            *(image_gradient.view(-1, channels), left_over_gradient, transmittance, *scratch, intersection_gradients),
            ranges=pieces,
        )
        return gather_by_gaussian(unsorted, intersection_gradients)

    return backward


def halvings(alpha_threshold: float) -> int:
    """How often the CPU's polynomial exponential halves its argument to reach down to log(alpha_threshold)."""
    return max(1, math.ceil(math.log2(-math.log(alpha_threshold) / 0.7)))


def balanced_pieces(lists: TileLists) -> Tensor:
    """[K + 1] int32: where ranges of tiles begin that hold about the same number of intersections each, and where the
    last one ends."""
    tile_count = lists.ranges.shape[0]
    work = (lists.ranges[:, 1] - lists.ranges[:, 0]).add(16).cumsum(0).double()  # 16: a tile costs something in itself
    pieces = min(thread_count() * PIECES_PER_THREAD, tile_count)
    goals = torch.arange(pieces + 1, dtype=torch.float64) * (float(work[-1]) / pieces)
    bounds = torch.searchsorted(work, goals, out_int32=True)
    bounds[0], bounds[-1] = 0, tile_count
    return bounds


def blend_on_cuda(
    features, lists: TileLists, records, image, transmittance, alpha_threshold: float, deterministic: bool
) -> Adjoint:
    """Fill image [H, W, C] and transmittance [H, W] by block kernels (also on CPU fibers, where tests ask for them)."""
    scalar, cuda = warp_scalar(features.dtype), features.device.type == "cuda"
    height, width, channels = image.shape
    rows = padded(features)
    last = blend_blocks(rows, lists, records, image, transmittance, alpha_threshold)
    # Padded they are larger, and few are not padded again.
    count, kept = len(features), rows if len(features) <= ONE_SORT else features
    del rows

    def backward(image_gradient: Tensor, transmittance_gradient: Tensor | None) -> Tensor:
        if transmittance_gradient is None:
            transmittance_gradient = transmittance.view(-1)[:0]
        kernel = blend_cuda_adjoint.backward_kernel(scalar, channels, deterministic, cuda)
        listed, frame = (lists.ranges, lists.gaussians, lists.corners), (lists.columns, width, height, alpha_threshold)
        gradients, sizes = (image_gradient, transmittance_gradient), (blend_cuda_adjoint.ROWS, channels + 6)
        given = *listed, *records, padded(kept).reshape(-1, 4), *frame, transmittance, last, *gradients, *sizes
        if not deterministic:
            by_rows = blend_cuda_adjoint.adds_rows(scalar, deterministic, cuda)
            columns = channels + 6
            gathered = transmittance.new_zeros(count, blend_cuda.padded_channels(columns) if by_rows else columns)
            launch_blocks(kernel, lists, blend_cuda.BLOCKS_PER_TILE, *given, 0, lists.gaussians, gathered)
            return gathered
        unsorted, by_intersection = lists.unsorted, transmittance.new_zeros(lists.intersection_count, channels + 6)
        assert unsorted is not None, "sums in a fixed order need the intersections as they were emitted"
        for corner in range(blend_cuda.BLOCKS_PER_TILE):
            launch_blocks(kernel, lists, 1, *given, corner, unsorted.places, by_intersection)
        return gather_by_gaussian(unsorted, by_intersection)

    return backward


def blend_blocks(rows, lists: TileLists, records, image, transmittance, alpha_threshold: float) -> Tensor:
    """Fill image [H, W, C] and transmittance [H, W] from padded() features. Returns [H W] int32, 1 + list place of the
    last Gaussian that a pixel shows."""
    assert lists.corners is not None, "a GPU's lists tell corners"
    height, width, channels = image.shape
    last = torch.empty(height * width, dtype=torch.int32, device=rows.device)
    kernel = blend_cuda.forward_kernel(warp_scalar(rows.dtype), channels, rows.device.type == "cuda")
    listed, frame = (lists.ranges, lists.gaussians, lists.corners), (lists.columns, width, height, alpha_threshold)
    given = *listed, *records, rows.reshape(-1, 4), *frame, image, transmittance, last
    launch_blocks(kernel, lists, blend_cuda.BLOCKS_PER_TILE, *given)
    return last


def launch_blocks(kernel, lists: TileLists, blocks_per_tile: int, *arguments) -> None:
    """Launches a block kernel over the tiles."""
    block = blend_cuda.BLOCK_DIM
    launch(kernel, lists.columns * lists.rows * blocks_per_tile * block, *arguments, block_dim=block)


def padded(features: Tensor) -> Tensor:
    """Features [N, C] with columns for whole rows of four, which block kernels read at once."""
    count, channels = features.shape
    if channels != (columns := blend_cuda.padded_channels(channels)):
        rows = features.new_empty(count, columns)
        launch(blend_cuda.pad_rows_kernel(warp_scalar(rows.dtype), channels), rows.numel(), features, rows)
        return rows
    return features.clone() if features.data_ptr() % 16 else features


def gather_by_gaussian(unsorted: UnsortedIntersections, by_intersection: Tensor) -> Tensor:
    """[N, columns]: for each Gaussian the sum of its rows of by_intersection [M, columns], front tile to last.

    by_intersection: rows in the order in which intersections were before the sort by tile.
    """
    intersection_count, columns = by_intersection.shape
    count = unsorted.order.shape[0]
    gathered = by_intersection.new_zeros(count, columns)
    if intersection_count:
        ends = unsorted.ends.clamp(0, intersection_count)  # beyond a max_intersections there are no rows
        kernel = tile_kernels(warp_scalar(by_intersection.dtype)).gather_intersections
        launch(kernel, count, unsorted.order, ends, by_intersection, columns, gathered)
    return gathered
