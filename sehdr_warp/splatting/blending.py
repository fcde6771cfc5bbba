"""The last stage of a render: blend the tile lists front to back, any number of channels in one pass."""

import math
from functools import lru_cache

import torch
import warp as wp

from ..kernels import blend_cpu
from ..kernels.constants import TILE_SIZE
from ..kernels.geometry import vector
from . import threads
from .bridge import differentiable
from .dtypes import warp_scalar
from .tile_lists import TileLists


@differentiable
def blend(
    program, means2d, conics, opacities, features, *, lists: TileLists, width: int, height: int, alpha_threshold: float
):
    """Blend features [N, C] over the tile lists: image [H, W, C] and alpha [H, W].

    Differentiable with respect to means2d [N, 2], conics [N, 3], opacities [N] and features. Which entries count is
    decided by the lists and by alpha_threshold, and taken as given in the derivative.
    """
    if program.is_cpu:
        return _blend_on_cpu(program, means2d, conics, opacities, features, lists, width, height, alpha_threshold)
    from .blending_cuda import blend_on_cuda

    return blend_on_cuda(program, means2d, conics, opacities, features, lists, width, height, alpha_threshold)


def _blend_on_cpu(program, means2d, conics, opacities, features, lists, width, height, alpha_threshold):
    scalar = warp_scalar(features.dtype)
    channels = features.shape[1]
    inputs = {
        "means2d": program.read(means2d),
        "conics": program.read(conics),
        "opacities": program.read(opacities),
        "features": program.read(features),
    }
    image = program.write((height, width, channels), scalar)
    alpha = program.write((height, width), scalar)
    halvings = exponent_halvings(alpha_threshold)
    row = vector(TILE_SIZE, scalar)
    tile_count = lists.columns * lists.rows

    def rows(*shape):
        return wp.from_torch(features.new_empty(tile_count, *shape, TILE_SIZE), dtype=row, requires_grad=False)

    pieces, tiles = _balanced_pieces(lists, halvings)
    iota = wp.from_torch(torch.arange(TILE_SIZE, dtype=features.dtype).reshape(1, TILE_SIZE), dtype=row)
    order_of_work = wp.from_torch(tiles)
    vec4 = vector(4, scalar)
    ranges = wp.from_torch(lists.ranges, dtype=wp.vec2i)
    entries = wp.from_torch(lists.gaussians)
    shapes = wp.from_torch(lists.shapes, dtype=vec4)
    ellipses = wp.from_torch(lists.ellipses, dtype=vec4)
    transmittance, last = rows(TILE_SIZE), rows(TILE_SIZE)
    threads.launch_ranges(
        blend_cpu.forward_kernel(scalar, channels, halvings),
        pieces,
        [
            order_of_work,
            ranges,
            entries,
            shapes,
            ellipses,
            inputs["features"],
            lists.columns,
            width,
            height,
            alpha_threshold,
            iota,
            transmittance,
            rows(channels, TILE_SIZE),
            last,
            image.reshape((height * width, channels)),
            alpha.flatten(),
        ],
        program.device,
    )

    def adjoint():
        entry_gradients = features.new_empty(lists.entry_count, channels + 6)
        threads.launch_ranges(
            blend_cpu.backward_kernel(scalar, channels, halvings),
            pieces,
            [
                order_of_work,
                ranges,
                entries,
                wp.from_torch(lists.emission),
                shapes,
                ellipses,
                inputs["features"],
                lists.columns,
                width,
                height,
                alpha_threshold,
                iota,
                transmittance,
                last,
                image.grad.reshape((height * width, channels)),
                alpha.grad.flatten(),
                rows(TILE_SIZE),
                rows(channels, TILE_SIZE),
                rows(TILE_SIZE),
                rows(TILE_SIZE),
                wp.from_torch(entry_gradients),
            ],
            program.device,
        )
        gathered = torch.empty(features.shape[0], channels + 6, dtype=features.dtype)
        threads.launch_ranges(
            blend_cpu.gather_kernel(scalar),
            threads.even_ranges(features.shape[0]),
            [
                wp.from_torch(lists.order),
                wp.from_torch(lists.ends),
                wp.from_torch(entry_gradients),
                channels + 6,
                wp.from_torch(gathered),
            ],
            program.device,
        )
        add_gradients(inputs, gathered, channels)

    program.record_adjoint(adjoint)
    return image, alpha


def add_gradients(inputs: dict[str, wp.array], gathered: torch.Tensor, channels: int) -> None:
    """Add the columns of gathered [N, C + 6] (features, conic a b c, x, y, opacity) to the inputs' gradients."""
    columns = {
        "features": gathered[:, :channels],
        "conics": gathered[:, channels : channels + 3],
        "means2d": gathered[:, channels + 3 : channels + 5],
        "opacities": gathered[:, channels + 5],
    }
    for name, gradient in columns.items():
        if inputs[name].grad is not None:
            wp.to_torch(inputs[name].grad, requires_grad=False).add_(gradient)


def exponent_halvings(alpha_threshold: float) -> int:
    """How often the CPU's polynomial exponential halves its argument to reach down to log(alpha_threshold)."""
    return max(1, math.ceil(math.log2(-math.log(alpha_threshold) / 0.7)))


def _balanced_pieces(lists: TileLists, halvings: int):
    """Ranges over the tiles that hold about the same number of entries each, and the tiles in drawing order."""
    tiles = _all_tiles(lists.columns * lists.rows)
    work = (lists.ranges[:, 1] - lists.ranges[:, 0]).add(16).cumsum(0)
    pieces = min(threads.thread_count() * 8, tiles.shape[0])
    goals = torch.arange(1, pieces, dtype=torch.float64) * (float(work[-1]) / pieces)
    cuts = torch.searchsorted(work.double(), goals).tolist()
    bounds = sorted({0, *cuts, tiles.shape[0]})
    return list(zip(bounds, bounds[1:])), tiles


@lru_cache(maxsize=8)
def _all_tiles(count: int) -> torch.Tensor:
    return torch.arange(count, dtype=torch.int32)
