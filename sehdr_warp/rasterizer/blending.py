"""The last stage of a render: blend the tile lists front to back, any number of channels in one pass.

blend() calls the backend of its device, blend_on_cpu() or blend_on_cuda(), which fills the image and returns the
backward pass: a function of the gradients with respect to image and transmittance (None for 0). It returns a row of
gradients for each Gaussian, [N, C + 6 or more]: features, conic a b c, x, y, opacity, and columns that pad the row.
with_gradient() makes this a node of the autograd graph, whose inputs are in the order of these columns.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import blend_cpu
from ..kernels.constants import TILE_SIZE
from ..parallel import thread_count
from .blending_cuda import blend_on_cuda
from .gradients import sum_by_gaussian
from .memory import check_room
from .projection import Splats2D
from .tile_lists import PackedSplats, TileLists
from .torch_contract import direct_apply, keeps_graph, once_differentiable
from .warp_launch.launching import launch, warp_scalar

ROWS_OF_TILE = blend_cpu.HALVES * TILE_SIZE  # Of LANES pixels each
RANGES_PER_THREAD = 16  # Ranges of tiles on the CPU: their work differs by more than their intersections.
GradientsByTensor = Callable[[Tensor, Tensor | None], Sequence[Tensor]]
"""Maps the gradients with respect to image and transmittance (None for 0) to those with respect to what was blended."""


class BlendResult(NamedTuple):
    """A blended image and its backward pass, with no graph behind them."""

    image: Tensor  # [H, W, C]
    transmittance: Tensor  # [H, W]
    backward: GradientsByTensor  # Their backward pass, for the tensors that with_gradient() gets


def blend(
    splats: Splats2D, lists: TileLists, packed: PackedSplats, alpha_threshold: float, deterministic: bool = False
) -> tuple[Tensor, Tensor]:
    """Blend splats over their tile lists; return the image [H, W, C] and the transmittance [H, W].

    Differentiable once with respect to means, conics, opacities and features. Which intersections count is decided by
    the lists and by alpha_threshold, and is constant in the derivative.

    deterministic: on a GPU, sum gradients in a fixed order, as the CPU always does.
    """
    features, channels = splats.features, splats.features.shape[1]
    on_gpu = features.device.type == "cuda"
    if not on_gpu:  # Of each pixel the channels, twice, and three further numbers are written.
        check_room(lists.height * lists.width * (2 * channels + 3) * features.element_size())
    image = features.new_empty(lists.height, lists.width, channels)
    transmittance = features.new_empty(image.shape[:2])
    # Detached: the autograd node owns the backward function, which must not refer to the node's own results.
    arguments = features.detach(), lists, packed, image.detach(), transmittance.detach(), alpha_threshold
    gradient_rows = blend_on_cuda(*arguments, deterministic) if on_gpu else blend_on_cpu(*arguments)

    def backward(grad_image: Tensor, grad_transmittance: Tensor | None) -> Sequence[Tensor]:
        rows = gradient_rows(grad_image, grad_transmittance)
        *others, opacity_and_padding = rows.tensor_split((channels, channels + 3, channels + 5), 1)
        return *others, opacity_and_padding.select(1, 0)

    result = BlendResult(image, transmittance, backward)
    return with_gradient(result, features, splats.conics, splats.means2d, splats.opacities)


def with_gradient(result: BlendResult, features: Tensor, *others: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return a result's image and transmittance as differentiable functions of what they were blended from.

    features, others: the tensors whose gradients the result's backward pass returns, in its order.
    """
    if not torch.is_grad_enabled():
        return result.image, result.transmittance
    return _apply_blend(result, features, *others)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, result: BlendResult, features, *others):
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
            return (None,) * len(ctx.needs_input_grad)
        _, width, channels = ctx.sizes
        strides = width * channels, channels, 1
        if grad_image is None:
            grad_image = grad_transmittance.new_zeros(ctx.sizes)
        elif grad_image.stride() != strides:
            # Of an axis of length 1 torch calls any stride contiguous, and kernels do not.
            grad_image = grad_image.contiguous().as_strided(ctx.sizes, strides)
        if grad_transmittance is not None:
            grad_transmittance = grad_transmittance.contiguous()
        return None, *gradients_of(grad_image, grad_transmittance)


_apply_blend = direct_apply(_Blend)


def blend_on_cpu(
    features: Tensor,
    lists: TileLists,
    packed: PackedSplats,
    image: Tensor,
    transmittance: Tensor,
    alpha_threshold: float,
) -> Callable[[Tensor, Tensor | None], Tensor]:
    """Fill image [H, W, C] and transmittance [H, W] by tiles; sums have a fixed order."""
    emit_order, tiles, channels = lists.emit_order, lists.grid.tiles, features.shape[1]
    assert emit_order is not None, "sums in a fixed order need the intersections as they were emitted"
    highest = float(packed.means_opacities[:, 2].max()) if len(features) else 0.0
    scalar, squarings = warp_scalar(features.dtype), exp_squarings(alpha_threshold / max(highest, 1.0))
    ranges = balanced_ranges(lists)
    lane_offsets = torch.arange(blend_cpu.LANES, dtype=features.dtype, device=features.device)
    sizes = lists.grid.columns, lists.width, lists.height
    shared = packed.means_opacities, packed.conics_cutoffs, features, *sizes, alpha_threshold, lane_offsets

    def scratch(*shape: int) -> Tensor:
        return features.new_empty(tiles, *shape, blend_cpu.LANES)

    tile_transmittance, last_contributor = scratch(ROWS_OF_TILE), scratch(ROWS_OF_TILE)
    inputs = lists.tile_ranges, lists.gaussians, *shared
    outputs = last_contributor, image.view(-1, channels), transmittance
    arguments = *inputs, tile_transmittance, scratch(channels, ROWS_OF_TILE), *outputs
    launch(blend_cpu.forward_kernel(scalar, channels, squarings), tiles, *arguments, ranges=ranges)

    def backward(grad_image: Tensor, grad_transmittance: Tensor | None) -> Tensor:
        if grad_transmittance is None:
            grad_transmittance = torch.zeros_like(transmittance)
        # The kernel takes it back to the front, in place.
        to_front = tile_transmittance.clone() if keeps_graph() else tile_transmittance
        grad_intersections = features.new_empty(lists.intersection_count, channels + 6)
        gradients = last_contributor, grad_image.view(-1, channels), grad_transmittance, to_front
        by_pixel = scratch(ROWS_OF_TILE), scratch(channels, ROWS_OF_TILE)
        by_row = scratch(TILE_SIZE), scratch(TILE_SIZE), scratch(channels + 6)
        inputs = lists.tile_ranges, lists.gaussians, lists.emit_indices, *shared
        arguments = *inputs, *gradients, *by_pixel, *by_row, grad_intersections
        launch(blend_cpu.backward_kernel(scalar, channels, squarings), tiles, *arguments, ranges=ranges)
        return sum_by_gaussian(grad_intersections, *emit_order)

    return backward


def exp_squarings(smallest: float) -> int:
    """Return how often the CPU's polynomial exponential is squared to reach down to log(smallest)."""
    return max(1, math.ceil(math.log2(-math.log(smallest) / 0.7)))


def balanced_ranges(lists: TileLists) -> Tensor:
    """Return [K + 1] int32: where ranges of tiles with about the same work begin, and where the last one ends."""
    tile_count = lists.grid.tiles
    lengths = lists.tile_ranges[:, 1] - lists.tile_ranges[:, 0]
    work = lengths.add(16).cumsum(0).double()  # 16: a tile costs something in itself.
    ranges = min(thread_count() * RANGES_PER_THREAD, tile_count)
    goals = torch.arange(ranges + 1, dtype=torch.float64, device=work.device) * (float(work[-1]) / ranges)
    bounds = torch.searchsorted(work, goals, out_int32=True)
    bounds[0], bounds[-1] = 0, tile_count
    return bounds
