"""Absolute gradients of 2D means beside the plain ones (kernels/absolute_gradient.py)."""

from collections.abc import Callable

import torch
from torch import Tensor

from ..kernels.absolute_gradient import absolute_gradient_kernel
from ..kernels.constants import TILE_SIZE
from .blending import gather_by_gaussian
from .tile_lists import PackedSplats, TileLists
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
    """Return image and transmittance, whose backward pass first computes the absolute gradients of the 2D means.

    Args:
        image: [H, W, C] of blend().
        transmittance: [H, W] of blend().
        features: [N, C] that were blended.
        lists: of the Gaussians, on the CPU with TileLists.unsorted.
        packed: of the Gaussians.
        alpha_threshold: as of blend().
        store: called with [N, 2], the sums over pixels of |dL/dx| and |dL/dy|.
    """
    return _Watch.apply(image, transmittance, features.detach(), lists, packed, alpha_threshold, store)


class _Watch(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, transmittance, features, lists, packed, alpha_threshold, store):
        ctx.save_for_backward(features, packed.shapes, packed.ellipses)
        ctx.lists, ctx.alpha_threshold, ctx.store = lists, alpha_threshold, store
        return image.view_as(image), transmittance.view_as(transmittance)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_image, by_transmittance):
        features, shapes, ellipses = ctx.saved_tensors
        lists, channels = ctx.lists, features.shape[1]
        unsorted = lists.unsorted
        # On the CPU each intersection has a row, and whole tiles go to a thread: sums keep one order.
        places = lists.gaussians if unsorted is None else unsorted.places
        rows = features.new_zeros(len(features) if unsorted is None else len(places), 2)
        tiles = lists.columns * lists.rows
        launch(
            absolute_gradient_kernel(warp_scalar(features.dtype)),
            tiles * _PIXELS,
            lists.ranges,
            lists.gaussians,
            places,
            shapes,
            ellipses,
            features,
            lists.columns,
            lists.width,
            lists.height,
            ctx.alpha_threshold,
            by_image.contiguous().view(-1, channels),
            by_transmittance.contiguous().view(-1),
            rows,
            ranges=even_ranges(tiles, 1) * _PIXELS,
        )
        ctx.store(rows if unsorted is None else gather_by_gaussian(unsorted, rows))
        return by_image, by_transmittance, None, None, None, None, None
