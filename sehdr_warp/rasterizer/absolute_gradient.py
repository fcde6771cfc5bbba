"""Absolute gradients of 2D means beside the plain ones (kernels/absolute_gradient.py)."""

from collections.abc import Callable

import torch
from torch import Tensor

from ..kernels.absolute_gradient import absolute_gradient_kernel
from ..kernels.constants import TILE_SIZE
from .gradients import sum_by_gaussian
from .tile_lists import PackedSplats, TileLists
from .torch_contract import once_differentiable
from .warp_launch.launching import launch, warp_scalar
from .warp_launch.threads import even_ranges

_PIXELS = TILE_SIZE * TILE_SIZE


def watch_absolute_gradients(
    image: Tensor,
    transmittance: Tensor,
    features: Tensor,
    lists: TileLists,
    packed: PackedSplats,
    alpha_threshold: float,
    store: Callable[[Tensor], None],
) -> tuple[Tensor, Tensor]:
    """Return image and transmittance of blend(); their backward pass first computes absolute gradients of the means.

    The other arguments are blend()'s. store: called with [N, 2], the sums over pixels of |dL/dx| and |dL/dy|.
    """
    return _Watch.apply(image, transmittance, features.detach(), lists, packed, alpha_threshold, store)


class _Watch(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, transmittance, features, lists, packed, alpha_threshold, store):
        ctx.save_for_backward(features, packed.means_opacities, packed.conics_cutoffs)
        ctx.lists, ctx.alpha_threshold, ctx.store = lists, alpha_threshold, store
        return image.view_as(image), transmittance.view_as(transmittance)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image, grad_transmittance):
        features, means_opacities, conics_cutoffs = ctx.saved_tensors
        lists, channels = ctx.lists, features.shape[1]
        emit_order = lists.emit_order
        # On the CPU each intersection has gradients, and whole tiles go to a thread: sums keep one order.
        emit_indices = lists.gaussians if emit_order is None else lists.emit_indices
        gradients = features.new_zeros(len(features) if emit_order is None else len(emit_indices), 2)
        tiles, threshold = lists.grid.tiles, ctx.alpha_threshold
        inputs = lists.tile_ranges, lists.gaussians, emit_indices, means_opacities, conics_cutoffs, features
        sizes = lists.grid.columns, lists.width, lists.height
        upstream = grad_image.contiguous().view(-1, channels), grad_transmittance.contiguous().view(-1)
        arguments = *inputs, *sizes, threshold, *upstream, gradients
        kernel = absolute_gradient_kernel(warp_scalar(features.dtype))
        launch(kernel, tiles * _PIXELS, *arguments, ranges=even_ranges(tiles, 1) * _PIXELS)
        ctx.store(gradients if emit_order is None else sum_by_gaussian(gradients, *emit_order))
        return grad_image, grad_transmittance, None, None, None, None, None
