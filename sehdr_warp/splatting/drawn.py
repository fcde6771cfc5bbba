"""What the block kernels of a GPU have to do for a picture, counted."""

import torch
from torch import Tensor

from ..kernels import blend_cuda
from ..kernels.constants import ALPHA_THRESHOLD, LOW_PASS, NEAR, TILE_SIZE
from .launching import launch, warp_scalar
from .projection import project
from .tile_lists import TileLists, build_tile_lists, number_entries, pack_records


@torch.no_grad()
def drawn_pairs(
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    features: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
) -> tuple[int, int]:
    """The (Gaussian, tile) pairs of a picture, and the (Gaussian, warp) pairs that are drawn: those that touch the 8 x
    4 pixels of a warp and are not behind the last that any of these shows.

    Takes what rasterize() takes, for its own thresholds; on a GPU, or where the CPU runs blocks of threads.
    """
    given = (x.detach().contiguous() for x in (means, log_scales, quaternions, opacities, world_to_camera, intrinsics))
    options = {"near": NEAR, "low_pass": LOW_PASS, "alpha_threshold": ALPHA_THRESHOLD, "antialiased": False}
    means2d, conics, depths, opacities, extents = project(*given, width=width, height=height, **options)
    features = features.detach().contiguous()
    records, counts = pack_records(means2d, conics, opacities, extents, ALPHA_THRESHOLD, width, height, features)
    emission = features.device.type == "cpu"
    numbered = number_entries(counts, depths, extents, emission=emission)
    lists = build_tile_lists(records, *numbered, depths, extents, width, height, emission=emission)
    corners, last = _drawn(lists, records, features)
    lengths = (lists.ranges[:, 1] - lists.ranges[:, 0]).long()
    tiles = torch.repeat_interleave(torch.arange(len(lengths), device=last.device), lengths)
    places = torch.arange(len(tiles), device=last.device) - (lengths.cumsum(0) - lengths)[tiles]
    entries = lists.ranges[:, 0].long()[tiles] + places
    touched = (corners[entries, None].int() >> torch.arange(blend_cuda.BLOCKS_PER_TILE, device=last.device)) & 1
    drawn = touched.bool() & (places[:, None] < last[tiles])
    return lists.entry_count, int(drawn.sum())


def _drawn(lists: TileLists, records: tuple[Tensor, Tensor], features: Tensor) -> tuple[Tensor, Tensor]:
    """[M] the corners of its tile that each entry touches, a bit each; [tiles, BLOCKS_PER_TILE] by corner, 1 + list
    place of the last Gaussian that a pixel of it shows."""
    scalar, cuda, channels = warp_scalar(features.dtype), features.device.type == "cuda", features.shape[1]
    listed, tiles, pixels = (lists.ranges, lists.gaussians), len(lists.ranges), lists.width * lists.height
    corners = torch.zeros(lists.entry_count, dtype=torch.uint8, device=features.device)
    launch(blend_cuda.corners_kernel(scalar), lists.entry_count, *listed, *records, lists.columns, corners)
    rows = torch.nn.functional.pad(features, (0, blend_cuda.padded_channels(channels) - channels)).view(-1, 4)
    frame = lists.columns, lists.width, lists.height, ALPHA_THRESHOLD
    last = torch.empty(pixels, dtype=torch.int32, device=features.device)
    made = features.new_empty(pixels, channels), features.new_empty(pixels), last
    size = tiles * blend_cuda.BLOCKS_PER_TILE * blend_cuda.BLOCK_DIM
    kernel = blend_cuda.forward_kernel(scalar, channels, cuda)
    launch(kernel, size, *listed, corners, *records, rows, *frame, *made, block_dim=blend_cuda.BLOCK_DIM)
    beyond = 0, lists.columns * TILE_SIZE - lists.width, 0, lists.rows * TILE_SIZE - lists.height
    last = torch.nn.functional.pad(last.view(lists.height, lists.width), beyond)
    # Rows of tiles, of their corners, of pixels; then columns of each.
    by_corner = last.view(lists.rows, TILE_SIZE // 4, 4, lists.columns, TILE_SIZE // 8, 8).amax((2, 5))
    return corners, by_corner.permute(0, 2, 1, 3).reshape(tiles, blend_cuda.BLOCKS_PER_TILE)
