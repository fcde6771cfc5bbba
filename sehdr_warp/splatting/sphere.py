"""Splats seen in any directions from one point: environment maps, as latitude and longitude or the faces of a cube."""

import torch
from torch import Tensor

from ..kernels.constants import ALPHA_THRESHOLD, LOW_PASS, NEAR, TILE_SIZE
from ..kernels.sphere import BLOCK_TILES, projection_kernel, sphere_kernels
from .checks import check_opacities, check_tensors
from .launching import launch, warp_scalar
from .memory import memory_told
from .tile_lists import checked_room, depth_order, find_ranges, sort_by_tile


@torch.no_grad()
def rasterize_directions(
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    features: Tensor,
    position: Tensor,
    directions: Tensor,
    *,
    focal_length: float,
    pixel_angle: float = 0.0,
    antialiased: bool = False,
    near: float = NEAR,
    alpha_threshold: float = ALPHA_THRESHOLD,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians along unit directions [H, W, 3] from a position [3]: image [H, W, C] and transmittance [H, W].

    means, log_scales [N, 3]; quaternions [N, 4]; opacities [N]; features [N, C]: as rasterize() takes them.
    focal_length: of the cameras that the Gaussians were trained on, in pixels: their pixels' footprint belongs to what
        a Gaussian looks like. pixel_angle: of the picture's pixels, radians; where they are larger, Gaussians are
        smoothed to them and keep their energy. Order is by distance from the position. Not differentiable.
    Neighboring pixels should look in neighboring directions; blocks of 128 x 128 pixels are culled as one.

    Raises TypeError and ValueError as rasterize() does, OutOfMemory if memory does not suffice.
    """
    check_tensors(
        means=(means, ("N", 3)),
        log_scales=(log_scales, ("N", 3)),
        quaternions=(quaternions, ("N", 4)),
        opacities=(opacities, ("N",)),
        features=(features, ("N", "C")),
        position=(position, (3,)),
        directions=(directions, ("H", "W", 3)),
    )
    check_opacities(opacities)
    height, width = directions.shape[:2]
    count, channels = features.shape
    scalar = warp_scalar(means.dtype)
    footprint = LOW_PASS / focal_length**2
    smoothing = max(LOW_PASS * pixel_angle**2 - footprint, 0.0)
    with memory_told(means.device, lambda: (count, width, height, channels)):
        caps, across, along = means.new_empty(count, 4), torch.empty_like(means), torch.empty_like(means)
        opacities2d, distances = torch.empty_like(opacities), torch.empty_like(opacities)
        given = (tensor.contiguous() for tensor in (means, log_scales, quaternions, opacities, position))
        launch(
            projection_kernel(scalar, antialiased),
            count,
            *(*given, near, footprint, smoothing, alpha_threshold),
            *(caps, across, along, opacities2d, distances),
        )
        opacities2d[~features.isfinite().all(1)] = 0
        columns, rows = -(-width // TILE_SIZE), -(-height // TILE_SIZE)
        directions = directions.contiguous()
        tile_caps, block_caps = (caps_of(directions, side * TILE_SIZE) for side in (1, BLOCK_TILES))
        kernels = sphere_kernels(scalar, channels)
        order = depth_order(distances, caps[:, 3:].expand(-1, 2).contiguous())
        frame = order, caps, tile_caps, block_caps, columns, rows
        counts, none = torch.empty_like(order), order[:0]
        launch(kernels.list_tiles, count, *frame, order, counts, none, none, smallest=256)
        room = checked_room(int(counts.sum(dtype=torch.int64)), count, columns, rows)
        starts = counts.cumsum(0, dtype=torch.int32) - counts
        tiles, gaussians = (torch.empty(2 * room, dtype=torch.int32, device=order.device) for _ in range(2))
        launch(kernels.list_tiles, count * bool(room), *frame, starts, counts, tiles, gaussians, smallest=256)
        tiles, gaussians, _ = sort_by_tile(tiles, gaussians, room, columns * rows, False)
        ranges = find_ranges(tiles, columns * rows)
        image, transmittance = means.new_zeros(height, width, channels), means.new_ones(height, width)
        launch(
            kernels.blend,
            columns * rows * TILE_SIZE * TILE_SIZE,
            *(ranges, gaussians, directions.view(-1, 3), caps, across, along, opacities2d, features.contiguous()),
            *(columns, width, height, alpha_threshold, image.view(-1, channels), transmittance),
            smallest=TILE_SIZE * TILE_SIZE,
        )
    return image, transmittance


def caps_of(directions: Tensor, side: int) -> Tensor:
    """[blocks, 4] by rows: the mean direction of each block of side x side pixels, and the largest angle from it."""
    height, width = directions.shape[:2]
    rows, columns = -(-height // side), -(-width // side)
    # What is missing at the end repeats the last pixels.
    down = torch.arange(rows * side, device=directions.device).clamp(max=height - 1)
    right = torch.arange(columns * side, device=directions.device).clamp(max=width - 1)
    blocks = directions[down][:, right].view(rows, side, columns, side, 3).transpose(1, 2).reshape(-1, side * side, 3)
    # A block around a pole or the whole sphere may have no mean: its cap is then everything.
    mean = blocks.mean(1)
    length = mean.norm(dim=1, keepdim=True)
    axis = torch.where(length > 1e-3, mean / length.clamp_min(1e-3), blocks[:, 0])
    # By the chord: an arc cosine loses half of the digits near 1.
    chord = (blocks - axis[:, None]).norm(dim=2).amax(1)
    return torch.cat([axis, 2 * torch.asin((chord / 2).clamp(max=1))[:, None]], dim=1).contiguous()
