"""Count what the block kernels of a GPU blend."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sehdr_warp.kernels.blend_cuda import BLOCKS_PER_TILE
from sehdr_warp.kernels.constants import ALPHA_THRESHOLD, TILE_SIZE
from sehdr_warp.rasterizer.blending_cuda import blend_on_cuda
from sehdr_warp.rasterizer.projection import Splats2D, project_to_camera
from sehdr_warp.rasterizer.render_options import RenderOptions
from sehdr_warp.rasterizer.tile_lists import build_tile_lists, order_gaussians, pack_splats


class Workload(NamedTuple):
    """Work of one image.

    Attributes:
        intersections: (Gaussian, tile) pairs.
        blended: (Gaussian, warp) pairs that are blended: the Gaussian touches the 8 x 4 pixels of the warp and is not
            behind the last one that any of these shows.
    """

    intersections: int
    blended: int


@torch.no_grad()
def count_blended_pairs(arguments: Sequence[Tensor], width: int, height: int) -> Workload:
    """Return the work of an image.

    Args:
        arguments: the seven tensors that rasterize() takes first, for one camera, on a GPU (or where the CPU runs
            blocks of threads).
        width: of the image, pixels.
        height: of the image, pixels.
    """
    means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics = (
        tensor.detach().contiguous() for tensor in arguments
    )
    options = RenderOptions(width, height)
    projected = project_to_camera(means, log_scales, quaternions, opacities, world_to_camera, intrinsics, options)
    packed = pack_splats(Splats2D(*projected, features), ALPHA_THRESHOLD, width, height)
    lists = build_tile_lists(packed, order_gaussians(packed, keep_emit_order=False), width, height)
    assert lists.subtile_masks is not None, "block kernels need lists with subtile_masks"
    image, transmittance = features.new_empty(height, width, features.shape[1]), features.new_empty(height, width)
    blended = blend_on_cuda(features, lists, packed, image, transmittance, ALPHA_THRESHOLD, deterministic=False)
    last_contributor = blended.last_contributor
    columns, rows = lists.grid
    beyond = 0, columns * TILE_SIZE - width, 0, rows * TILE_SIZE - height
    last_contributor = torch.nn.functional.pad(last_contributor.view(height, width), beyond)
    # Rows of tiles, of their subtile_masks, of pixels; then columns of each.
    last_contributor = last_contributor.view(rows, TILE_SIZE // 4, 4, columns, TILE_SIZE // 8, 8).amax((2, 5))
    last_contributor = last_contributor.permute(0, 2, 1, 3).reshape(len(lists.tile_ranges), BLOCKS_PER_TILE)
    lengths = (lists.tile_ranges[:, 1] - lists.tile_ranges[:, 0]).long()
    tiles = torch.repeat_interleave(torch.arange(len(lengths), device=last_contributor.device), lengths)
    places = torch.arange(len(tiles), device=last_contributor.device) - (lengths.cumsum(0) - lengths)[tiles]
    intersections = lists.tile_ranges[:, 0].long()[tiles] + places
    touched = (
        lists.subtile_masks[intersections, None].int() >> torch.arange(BLOCKS_PER_TILE, device=last_contributor.device)
    ) & 1
    pairs = touched.bool() & (places[:, None] < last_contributor[tiles])
    return Workload(lists.intersection_count, int(pairs.sum()))
