"""The last stage of a render: blend the tile lists front to back, any number of channels in one pass."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels import blend_cpu, blend_cuda, blend_cuda_backward
from ..kernels.constants import TILE_SIZE
from ..kernels.tiles import tile_kernels
from ..parallel import thread_count
from .tile_lists import MAX_SINGLE_SORT, EmitOrder, PackedSplats, TileLists
from .torch_contract import direct_apply, keeps_graph, once_differentiable
from .warp_launch.launching import fixed_launch, launch, warp_scalar, warp_stream

PIECES_PER_THREAD = 16  # Of the image, on the CPU: their work differs by more than their intersections.
Backward = Callable[[Tensor, Tensor | None], Tensor]
"""Maps the gradients by image and transmittance (None for 0) to those by Gaussian, [N, C + 6 or more]: features, conic
a b c, x, y, opacity, and columns that pad a row."""


class BlendResult(NamedTuple):
    """A blended image and its backward pass, with no graph behind them.

    Attributes:
        image: [H, W, C].
        transmittance: [H, W].
        backward: their backward pass.
    """

    image: Tensor
    transmittance: Tensor
    backward: Backward


def blend(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    features: Tensor,
    lists: TileLists,
    packed: PackedSplats,
    alpha_threshold: float,
    deterministic: bool = False,
) -> tuple[Tensor, Tensor]:
    """Blend features over the tile lists; return the image [H, W, C] and the transmittance [H, W].

    Differentiable once with respect to the first four. Which intersections count is decided by the lists and by
    alpha_threshold, and is constant in the derivative.

    Args:
        means2d: [N, 2].
        conics: [N, 3].
        opacities: [N].
        features: [N, C].
        lists: of the Gaussians.
        packed: of means2d, conics, opacities and alpha_threshold.
        alpha_threshold: contributions with a smaller alpha are left out.
        deterministic: on a GPU, sum gradients in a fixed order, as the CPU always does. Slower, and the gradients of
            every intersection take memory.
    """
    rows = features.detach()
    image = rows.new_empty(lists.height, lists.width, rows.shape[1])
    transmittance = rows.new_empty(image.shape[:2])
    backend = blend_on_cuda if rows.device.type == "cuda" else blend_on_cpu
    # The backward pass keeps some of these, but it must not keep the results of the node that keeps it: so detach them.
    backward = backend(rows, lists, packed, image.detach(), transmittance.detach(), alpha_threshold, deterministic)
    return with_gradient(means2d, conics, opacities, features, BlendResult(image, transmittance, backward))


def with_gradient(means2d, conics, opacities, features, result: BlendResult) -> tuple[Tensor, Tensor]:
    """Return a result's image and transmittance as differentiable functions of what they were blended from."""
    if not torch.is_grad_enabled():
        return result.image, result.transmittance
    return _apply_blend(means2d, conics, opacities, features, result)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, opacities, features, result: BlendResult):
        ctx.sizes, ctx.gradients_of = result.image.shape, result.backward
        # The backward pass reads them: torch then raises its own error if one is changed in place before.
        ctx.save_for_backward(features, result.transmittance)
        ctx.set_materialize_grads(False)
        return result.image, result.transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image, grad_transmittance):
        _ = ctx.saved_tensors  # Raises torch's errors for a freed graph and for changes in place.
        gradients_of = ctx.gradients_of
        if not keeps_graph():
            ctx.gradients_of = None
        if grad_image is None and grad_transmittance is None:
            return (None,) * 5
        _, width, channels = ctx.sizes
        grad_image = grad_transmittance.new_zeros(ctx.sizes) if grad_image is None else grad_image.contiguous()
        # Of an axis of length 1 torch calls any stride contiguous, and kernels do not.
        if grad_image.stride() != (width * channels, channels, 1):
            grad_image = grad_image.as_strided(ctx.sizes, (width * channels, channels, 1))
        gathered = gradients_of(grad_image, None if grad_transmittance is None else grad_transmittance.contiguous())
        rest = gathered.shape[1] - channels - 6
        grad_features, grad_conics, grad_means2d, grad_opacities, _ = gathered.split_with_sizes(
            (channels, 3, 2, 1, rest), 1
        )
        gradients = grad_means2d, grad_conics, grad_opacities[:, 0], grad_features
        return *(part if needed else None for part, needed in zip(gradients, ctx.needs_input_grad, strict=False)), None


_apply_blend = direct_apply(_Blend)


def blend_on_cpu(
    features: Tensor,
    lists: TileLists,
    packed: PackedSplats,
    image: Tensor,
    transmittance: Tensor,
    alpha_threshold: float,
    deterministic: bool,
) -> Backward:
    """Fill image [H, W, C] and transmittance [H, W]: balanced pieces of tiles, a thread each."""
    scalar, emit_order = warp_scalar(features.dtype), lists.emit_order
    assert emit_order is not None, "sums in a fixed order need the intersections as they were emitted"
    height, width, channels = image.shape
    kind = scalar, channels, exp_squarings(alpha_threshold)
    tile_count, pieces = lists.columns * lists.rows, balanced_pieces(lists)

    def rows(*shape):
        return features.new_empty(tile_count, *shape, blend_cpu.LANES)

    count = blend_cpu.HALVES * TILE_SIZE
    lane_offsets = torch.arange(blend_cpu.LANES, dtype=features.dtype, device=features.device)
    means_opacities, conics_cutoffs = packed.means_opacities, packed.conics_cutoffs
    frame = features, lists.columns, width, height, alpha_threshold, lane_offsets
    tile_transmittance, last_contributor = rows(count), rows(count)
    launch(
        blend_cpu.forward_kernel(*kind),
        tile_count,
        lists.tile_ranges,
        lists.gaussians,
        means_opacities,
        conics_cutoffs,
        *frame,
        tile_transmittance,
        rows(channels, count),
        last_contributor,
        image.view(-1, channels),
        transmittance,
        ranges=pieces,
    )

    def backward(grad_image: Tensor, grad_transmittance: Tensor | None) -> Tensor:
        if grad_transmittance is None:
            grad_transmittance = torch.zeros_like(transmittance)
        # The kernel takes the transmittance back to the front, in place.
        tile_state = tile_transmittance.clone() if keeps_graph() else tile_transmittance
        grad_intersections = features.new_empty(lists.intersection_count, channels + 6)
        launch(
            blend_cpu.backward_kernel(*kind),
            tile_count,
            lists.tile_ranges,
            lists.gaussians,
            emit_order.emit_indices,
            means_opacities,
            conics_cutoffs,
            *frame,
            last_contributor,
            grad_image.view(-1, channels),
            grad_transmittance,
            tile_state,
            rows(count),
            rows(channels, count),
            rows(TILE_SIZE),
            rows(TILE_SIZE),
            rows(channels + 6),
            grad_intersections,
            ranges=pieces,
        )
        return gather_by_gaussian(emit_order, grad_intersections)

    return backward


def exp_squarings(alpha_threshold: float) -> int:
    """Return how often the CPU's polynomial exponential is squared to reach down to log(alpha_threshold)."""
    return max(1, math.ceil(math.log2(-math.log(alpha_threshold) / 0.7)))


def balanced_pieces(lists: TileLists) -> Tensor:
    """Return [K + 1] int32: where ranges of tiles with about the same work begin, and where the last one ends."""
    tile_count = lists.tile_ranges.shape[0]
    work = (
        (lists.tile_ranges[:, 1] - lists.tile_ranges[:, 0]).add(16).cumsum(0).double()
    )  # 16: a tile costs something in itself
    pieces = min(thread_count() * PIECES_PER_THREAD, tile_count)
    goals = torch.arange(pieces + 1, dtype=torch.float64, device=work.device) * (float(work[-1]) / pieces)
    bounds = torch.searchsorted(work, goals, out_int32=True)
    bounds[0], bounds[-1] = 0, tile_count
    return bounds


def blend_on_cuda(
    features: Tensor,
    lists: TileLists,
    packed: PackedSplats,
    image: Tensor,
    transmittance: Tensor,
    alpha_threshold: float,
    deterministic: bool,
) -> "BlockBackward":
    """Fill image [H, W, C] and transmittance [H, W] by block kernels (in tests also in Warp's CPU block emulation)."""
    rows = pad_features(features)
    last_contributor = blend_blocks(rows, lists, packed, image, transmittance, alpha_threshold)
    # Padded features take more memory; few Gaussians keep them, so that they need not be padded again.
    saved = rows if len(features) <= MAX_SINGLE_SORT else features
    return BlockBackward(
        saved, image.shape[-1], lists, packed, transmittance, last_contributor, alpha_threshold, deterministic
    )


@dataclass(frozen=True)
class BlockBackward:
    """The backward pass of blend_on_cuda(); see Backward.

    Attributes:
        features: [N, C] or, padded, [N, more].
        channels: C.
        lists: that were blended.
        packed: Gaussians that were blended.
        transmittance: [H, W], the result.
        last_contributor: of blend_blocks().
        alpha_threshold: contributions with a smaller alpha were left out.
        deterministic: sum in a fixed order.
    """

    features: Tensor
    channels: int
    lists: TileLists
    packed: PackedSplats
    transmittance: Tensor
    last_contributor: Tensor
    alpha_threshold: float
    deterministic: bool

    def __call__(self, grad_image: Tensor, grad_transmittance: Tensor | None) -> Tensor:
        """Return the gradients by Gaussian."""
        if grad_transmittance is None:
            grad_transmittance = self.transmittance.view(-1)[:0]
        lists = self.lists
        if not self.deterministic:
            gathered = self._zeros()
            arguments = *self._arguments(grad_image, grad_transmittance), 0, lists.gaussians, gathered
            launch_blocks(self._kernel(), lists, blend_cuda.BLOCKS_PER_TILE, *arguments)
            return gathered
        grad_intersections = self.transmittance.new_zeros(lists.intersection_count, self.channels + 6)
        emit_order, arguments = lists.emit_order, self._arguments(grad_image, grad_transmittance)
        assert emit_order is not None, "sums in a fixed order need the intersections as they were emitted"
        for subtile in range(blend_cuda.BLOCKS_PER_TILE):
            launch_blocks(self._kernel(), lists, 1, *arguments, subtile, emit_order.emit_indices, grad_intersections)
        return gather_by_gaussian(emit_order, grad_intersections)

    def on_fixed_memory(self) -> Backward:
        """Return the backward pass for less host time; for use while all tensors stay where they are."""
        assert not self.deterministic, "sums in a fixed order are several launches"
        grad_image = self.transmittance.new_empty(*self.transmittance.shape, self.channels)
        grad_transmittance, gathered = torch.empty_like(self.transmittance), self._zeros()
        fixed = fixed_launch(
            self._kernel(),
            block_threads(self.lists, blend_cuda.BLOCKS_PER_TILE),
            *self._arguments(grad_image, grad_transmittance),
            0,
            self.lists.gaussians,
            gathered,
            whole=(grad_image, grad_transmittance, gathered),
            block_dim=blend_cuda.BLOCK_DIM,
        )
        device, shape = gathered.device, gathered.shape

        def backward(grad_image: Tensor, grad_transmittance: Tensor | None) -> Tensor:
            gathered = grad_image.new_zeros(shape)
            fixed.launch((), (grad_image, grad_transmittance, gathered), warp_stream(device))
            return gathered

        return backward

    def _zeros(self) -> Tensor:
        columns = self.channels + 6
        if blend_cuda_backward.adds_rows(warp_scalar(self.features.dtype), self.deterministic, self._cuda):
            columns = blend_cuda.padded_channels(columns)
        return self.transmittance.new_zeros(len(self.features), columns)

    @property
    def _cuda(self) -> bool:
        return self.features.device.type == "cuda"

    def _kernel(self) -> Any:
        scalar = warp_scalar(self.features.dtype)
        return blend_cuda_backward.backward_kernel(scalar, self.channels, self.deterministic, self._cuda)

    def _arguments(self, grad_image: Tensor, grad_transmittance: Tensor) -> tuple:
        lists, packed = self.lists, self.packed
        height, width = self.transmittance.shape
        return (
            *(lists.tile_ranges, lists.gaussians, lists.subtile_masks, packed.means_opacities, packed.conics_cutoffs),
            pad_features(self.features).reshape(-1, 4),
            *(lists.columns, width, height, self.alpha_threshold, self.transmittance, self.last_contributor),
            *(grad_image, grad_transmittance, blend_cuda_backward.ROWS, self.channels + 6),
        )


def blend_blocks(
    rows: Tensor, lists: TileLists, packed: PackedSplats, image: Tensor, transmittance: Tensor, alpha_threshold: float
) -> Tensor:
    """Fill image [H, W, C] and transmittance [H, W] from pad_features(); return the last Gaussian of each pixel.

    That is [H W] int32, 1 + its place in the tile's list, or 0.
    """
    assert lists.subtile_masks is not None, "block kernels need lists with subtile_masks"
    height, width, channels = image.shape
    last_contributor = torch.empty(height * width, dtype=torch.int32, device=rows.device)
    kernel = blend_cuda.forward_kernel(warp_scalar(rows.dtype), channels, rows.device.type == "cuda")
    launch_blocks(
        kernel,
        lists,
        blend_cuda.BLOCKS_PER_TILE,
        lists.tile_ranges,
        lists.gaussians,
        lists.subtile_masks,
        packed.means_opacities,
        packed.conics_cutoffs,
        rows.reshape(-1, 4),
        lists.columns,
        width,
        height,
        alpha_threshold,
        image,
        transmittance,
        last_contributor,
    )
    return last_contributor


def launch_blocks(kernel: Any, lists: TileLists, blocks_per_tile: int, *arguments: Any) -> None:
    """Launch a block kernel over the tiles."""
    launch(kernel, block_threads(lists, blocks_per_tile), *arguments, block_dim=blend_cuda.BLOCK_DIM)


def block_threads(lists: TileLists, blocks_per_tile: int) -> int:
    """Return the number of threads of a block kernel over the tiles."""
    return lists.columns * lists.rows * blocks_per_tile * blend_cuda.BLOCK_DIM


def pad_features(features: Tensor) -> Tensor:
    """Return features [N, C] with columns for whole rows of four, which block kernels read at once."""
    count, channels = features.shape
    if channels != (columns := blend_cuda.padded_channels(channels)):
        rows = features.new_empty(count, columns)
        launch(blend_cuda.pad_rows_kernel(warp_scalar(rows.dtype), channels), rows.numel(), features, rows)
        return rows
    return features.clone() if features.data_ptr() % 16 else features


def gather_by_gaussian(emit_order: EmitOrder, grad_intersections: Tensor) -> Tensor:
    """Return [N, columns]: for each Gaussian the sum of its rows of grad_intersections, in the order of tiles.

    grad_intersections: rows in the order of intersections before the sort by tile.
    """
    length, columns = grad_intersections.shape
    count = emit_order.order.shape[0]
    gathered = grad_intersections.new_zeros(count, columns)
    if length:
        cumulative_counts = emit_order.cumulative_counts.clamp(0, length)  # Beyond max_intersections there are no rows.
        kernel = tile_kernels(warp_scalar(grad_intersections.dtype)).gather_intersections
        launch(kernel, count, emit_order.order, cumulative_counts, grad_intersections, columns, gathered)
    return gathered
