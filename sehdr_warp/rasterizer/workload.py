"""What the block kernels of a GPU have to do for a picture, counted."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..kernels.blend_cuda import BLOCKS_PER_TILE
from ..kernels.constants import ALPHA_THRESHOLD, EPS2D, NEAR_PLANE, TILE_SIZE
from .blending import blend_blocks, padded
from .projection import project
from .tile_lists import build_tile_lists, order_intersections, pack_gaussians


@torch.no_grad()
def count_blended_pairs(splats: Sequence[Tensor], width: int, height: int) -> tuple[int, int]:
    """The (Gaussian, tile) pairs of a picture, and the (Gaussian, warp) pairs that are drawn: those that touch the 8 x
    4 pixels of a warp and are not behind the last that any of these shows.

    splats: the seven tensors that rasterize() takes first, for one camera, drawn with its own thresholds; on a GPU, or
    where the CPU runs blocks of threads.
    """
    given = (tensor.detach().contiguous() for tensor in splats)
    means, log_scales, quaternions, opacities, features, pose, intrinsics = given
    options = {"near_plane": NEAR_PLANE, "eps2d": EPS2D, "alpha_threshold": ALPHA_THRESHOLD, "antialiased": False}
    shapes = means, log_scales, quaternions, opacities
    projected = project(*shapes, pose, intrinsics, width=width, height=height, **options)
    means2d, conics, depths, opacities, extents = projected
    records, counts = pack_gaussians(means2d, conics, opacities, extents, ALPHA_THRESHOLD, width, height, features)
    numbered = order_intersections(counts, depths, extents, unsorted=False)
    lists = build_tile_lists(records, *numbered, depths, extents, width, height, unsorted=False)
    assert lists.corners is not None, "so few Gaussians that one sort makes their lists, which tells corners"
    image, left = features.new_empty(height, width, features.shape[1]), features.new_empty(height, width)
    last = blend_blocks(padded(features), lists, records, image, left, ALPHA_THRESHOLD)
    beyond = 0, lists.columns * TILE_SIZE - width, 0, lists.rows * TILE_SIZE - height
    last = torch.nn.functional.pad(last.view(height, width), beyond)
    # Rows of tiles, of their corners, of pixels; then columns of each.
    last = last.view(lists.rows, TILE_SIZE // 4, 4, lists.columns, TILE_SIZE // 8, 8).amax((2, 5))
    last = last.permute(0, 2, 1, 3).reshape(len(lists.ranges), BLOCKS_PER_TILE)
    lengths = (lists.ranges[:, 1] - lists.ranges[:, 0]).long()
    tiles = torch.repeat_interleave(torch.arange(len(lengths), device=last.device), lengths)
    places = torch.arange(len(tiles), device=last.device) - (lengths.cumsum(0) - lengths)[tiles]
    intersections = lists.ranges[:, 0].long()[tiles] + places
    touched = (lists.corners[intersections, None].int() >> torch.arange(BLOCKS_PER_TILE, device=last.device)) & 1
    drawn = touched.bool() & (places[:, None] < last[tiles])
    return lists.intersection_count, int(drawn.sum())
