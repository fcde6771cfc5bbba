"""The last stage of a render: blend the tile lists front to back, any number of channels in one pass."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import blend_cpu
from ..kernels.constants import TILE_SIZE
from ..parallel import thread_count
from .block_blending import blend_on_cuda
from .tile_lists import PackedSplats, TileLists
from .torch_contract import direct_apply, keeps_graph, once_differentiable
from .warp_launch.launching import launch, warp_scalar

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
        return emit_order.sum_by_gaussian(grad_intersections)

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
