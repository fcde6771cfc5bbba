"""The blend on the CPU: tiles in balanced pieces, one piece to a thread at a time."""

import math
from itertools import pairwise

import torch
import warp as wp

from ..kernels import blend_cpu
from ..kernels.constants import TILE_SIZE
from ..kernels.geometry import vector
from . import threads
from .arrays import view, warp_scalar
from .blend_style import BlendStyle
from .gathering import gather_by_gaussian
from .tile_lists import TileLists


def blend_on_cpu(
    device, features, lists: TileLists, records, image, left_over, alpha_threshold: float, style: BlendStyle
):
    """Fill image [H, W, C] and left_over [H, W], the transmittance; return the backward pass.

    It takes the records made again and the gradients of both, and gives [N, C + 6]: by feature, conic a b c,
    x, y, opacity.
    """
    scalar = warp_scalar(features.dtype)
    height, width, channels = image.shape
    halvings = exponent_halvings(alpha_threshold)
    degree = style.exponential_degree
    row, vec4 = vector(TILE_SIZE, scalar), vector(4, scalar)
    tile_count = lists.columns * lists.rows

    def rows(*shape):
        return view(features.new_empty(tile_count, *shape, TILE_SIZE), dtype=row)

    pieces = balanced_pieces(lists)
    iota = view(torch.arange(TILE_SIZE, dtype=features.dtype).reshape(1, TILE_SIZE), dtype=row)
    ranges, entries = view(lists.ranges, dtype=wp.vec2i), view(lists.gaussians)
    colours = view(features)
    frame = [lists.columns, width, height, alpha_threshold, iota]
    transmittance, last = rows(TILE_SIZE), rows(TILE_SIZE)
    threads.launch_ranges(
        blend_cpu.forward_kernel(scalar, channels, halvings, style.transmittance_min, degree),
        pieces,
        [
            ranges,
            entries,
            *(view(record, dtype=vec4) for record in records),
            colours,
            *frame,
            transmittance,
            rows(channels, TILE_SIZE),
            last,
            view(image.view(-1, channels)),
            view(left_over.view(-1)),
        ],
        device,
    )

    def backward(records, image_gradient: torch.Tensor, left_over_gradient: torch.Tensor) -> torch.Tensor:
        entry_gradients = features.new_empty(lists.entry_count, channels + 6)
        threads.launch_ranges(
            blend_cpu.backward_kernel(scalar, channels, halvings, degree),
            pieces,
            [
                ranges,
                entries,
                view(lists.emission.places),
                *(view(record, dtype=vec4) for record in records),
                colours,
                *frame,
                transmittance,
                last,
                view(image_gradient.view(-1, channels)),
                view(left_over_gradient.view(-1)),
                rows(TILE_SIZE),
                rows(channels, TILE_SIZE),
                rows(TILE_SIZE),
                rows(TILE_SIZE),
                view(entry_gradients),
            ],
            device,
        )
        return gather_by_gaussian(lists.emission, entry_gradients)

    return backward


def exponent_halvings(alpha_threshold: float) -> int:
    """How often the polynomial exponential halves its argument to reach down to log(alpha_threshold)."""
    return max(1, math.ceil(math.log2(-math.log(alpha_threshold) / 0.7)))


def balanced_pieces(lists: TileLists) -> list[tuple[int, int]]:
    """Ranges of tiles that hold about the same number of entries each, a few for every thread."""
    tile_count = lists.ranges.shape[0]
    work = (lists.ranges[:, 1] - lists.ranges[:, 0]).add(16).cumsum(0).double()  # 16: a tile costs something in itself
    pieces = min(threads.thread_count() * 8, tile_count)
    goals = torch.arange(1, pieces, dtype=torch.float64) * (float(work[-1]) / pieces)
    bounds = sorted({0, *torch.searchsorted(work, goals).tolist(), tile_count})
    return list(pairwise(bounds))
