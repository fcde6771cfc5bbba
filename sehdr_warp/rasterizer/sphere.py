"""Splats seen in any directions from one point: environment maps, as latitude and longitude or the faces of a cube."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels import sphere_cpu
from ..kernels.constants import ALPHA_THRESHOLD, EPS2D, NEAR_PLANE, TILE_SIZE
from ..kernels.sphere import BLOCK_TILES, projection_kernel, sphere_kernels
from .blending import exp_squarings
from .checks import (
    boolean,
    check_channels,
    check_directions,
    check_opacities,
    check_position,
    check_render_options,
    check_tensors,
    check_unit_vectors,
    is_angle,
    is_positive,
    real,
)
from .gradients import sum_by_gaussian
from .memory import oom_context
from .projection import expand_to_gaussians, launch_projection, torch_sums_gradients
from .tile_lists import EmitOrder, TileLists, check_intersection_count, depth_order, lists_by_tile, tile_grid
from .torch_contract import once_differentiable, torch_operation
from .warp_launch.launching import launch, warp_scalar

_PIXELS = TILE_SIZE * TILE_SIZE
TILES_AT_ONCE = 2048  # That the CPU blends in one launch
_ROWS = sphere_cpu.ROWS, sphere_cpu.LANES  # Shapes of a tile's scratch
_DIRECTIONS, _CAPS = (3, *_ROWS), (sphere_cpu.ROWS, 5)


@partial(torch_operation, compiles=True)
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
    near_plane: float = NEAR_PLANE,
    alpha_threshold: float = ALPHA_THRESHOLD,
    axes: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians along directions from a place: an environment map, or any picture of the sphere.

    Differentiable with respect to every tensor but axes and directions; the latter may not require a gradient. On the
    CPU gradients repeat bit for bit, whatever the number of threads. Neighboring pixels should look in neighboring
    directions; blocks of 128 x 128 pixels are culled as one.

    Args:
        means: [N, 3]; this and the next four as rasterize() takes them.
        log_scales: [N, 3].
        quaternions: [N, 4].
        opacities: [N].
        features: [N, C].
        position: [3] the place, world coordinates.
        directions: [H, W, 3] unit vectors.
        focal_length: of the cameras that the Gaussians were trained on, in pixels: their pixels' footprint belongs to
            what a Gaussian looks like.
        pixel_angle: of the picture's pixels, radians; where they are larger, Gaussians are smoothed to them and keep
            their energy.
        antialiased: as of rasterize(), but its factor is differentiated.
        near_plane: as of rasterize().
        alpha_threshold: as of rasterize().
        axes: [A, 3] unit vectors. Gaussians are ordered by their depth along the one nearest to their direction, as in
            perspective views along these; by default by their distance from the position.

    Returns:
        Image [H, W, C] and transmittance [H, W].

    Raises:
        TypeError: as rasterize() does; likewise ValueError.
        OutOfMemory: if memory does not suffice.
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
    if axes is not None:
        check_tensors(means=(means, ("N", 3)), axes=(axes, ("A", 3)))
        if not len(axes):
            raise ValueError(f"axes has shape {list(axes.shape)}, expected [A, 3] with at least one axis")
        check_unit_vectors("axes", axes)
    check_channels(features)
    check_opacities(opacities)
    check_position(position)
    real("focal_length", focal_length, is_positive, "a positive number")
    real("pixel_angle", pixel_angle, is_angle, "radians from 0 to 2 pi")
    check_render_options(near_plane, alpha_threshold)
    antialiased = boolean("antialiased", antialiased)
    height, width = directions.shape[:2]
    if not height * width:
        raise ValueError(f"directions has shape {list(directions.shape)}, expected [H, W, 3] with at least one pixel")
    check_directions(directions)
    footprint = EPS2D / focal_length**2
    smoothing = max(EPS2D * pixel_angle**2 - footprint, 0.0)
    with oom_context(means.device, lambda: (len(means), width, height, features.shape[1])):
        gaussians = tuple(tensor.contiguous() for tensor in (means, log_scales, quaternions, opacities, position))
        parameters = near_plane, footprint, smoothing, alpha_threshold
        own_positions = torch_sums_gradients(position)
        gaussians = expand_to_gaussians(gaussians) if own_positions else gaussians
        kernel = projection_kernel(warp_scalar(means.dtype), antialiased, own_positions)
        outputs = [means.new_empty(len(means), *shape) for shape in ((4,), (3,), (3,), (), ())]
        splats = _SphereSplats(*launch_projection(kernel, gaussians, parameters, outputs))
        opacities = splats.opacities.masked_fill(~features.isfinite().all(1), 0)
        blended = splats.caps, splats.across, splats.along, opacities, features.contiguous()
        keep_emit_order = means.is_cpu and torch.is_grad_enabled() and any(tensor.requires_grad for tensor in blended)
        directions = directions.contiguous()
        depths = splats.distances if axes is None else _depths(splats, axes)
        lists = _list_tiles(splats.caps.detach(), depths, directions, keep_emit_order)
        return _Blend.apply(*blended, directions, lists, alpha_threshold)


class _SphereSplats(NamedTuple):
    """Gaussians on the unit sphere around a position."""

    caps: Tensor  # [N, 4] unit direction, and the angle around it within which a Gaussian counts; 0 if culled
    across: Tensor  # [N, 3], with `along` the root of the inverse covariance
    along: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    distances: Tensor  # [N] from the position; 0 if culled


@torch.no_grad()
def _depths(splats: _SphereSplats, axes: Tensor) -> Tensor:
    """Return the depths [N] along the nearest of axes [A, 3], at least 0."""
    cosines = torch.zeros_like(splats.distances)
    for axis in axes:  # One by one: a matrix product may be in TF32, whose rounding changes the order.
        cosines = cosines.maximum(splats.caps[:, :3] @ axis)
    return splats.distances * cosines


@torch.no_grad()
def _list_tiles(caps: Tensor, depths: Tensor, directions: Tensor, keep_emit_order: bool) -> TileLists:
    """List for each tile the Gaussians whose cap meets the tile's own, by depth."""
    count, (height, width) = len(caps), directions.shape[:2]
    grid = tile_grid(width, height)
    tile_caps, block_caps = (caps_of(directions, side * TILE_SIZE) for side in (1, BLOCK_TILES))
    kernel = sphere_kernels(warp_scalar(caps.dtype), 1).list_tiles
    order = depth_order(depths, caps[:, 3:].expand(-1, 2).contiguous())
    shared = order, caps, *tile_caps, *block_caps, *grid
    counts, none = torch.empty_like(order), order[:0]
    launch(kernel, count, *shared, order, counts, none, none, min_range=256)
    cumulative_counts = counts.cumsum(0)
    total = cumulative_counts[-1] if count else cumulative_counts.new_zeros(())
    length = int(total)
    check_intersection_count(length, count, grid)
    starts = (cumulative_counts - counts).int()
    tiles, gaussians = (torch.empty(2 * length, dtype=torch.int32, device=order.device) for _ in range(2))
    launch(kernel, count * bool(length), *shared, starts, counts, tiles, gaussians, min_range=256)
    tile_ranges, gaussians, _, emit_indices = lists_by_tile(tiles, gaussians, length, None, grid, keep_emit_order)
    emit_order = EmitOrder(order.clone(), cumulative_counts) if keep_emit_order else None
    return TileLists(tile_ranges, gaussians, None, emit_order, emit_indices, width, height, None, total.clone())


def _launch_by_tiles(
    kernel: Any, tiles: int, inputs: Sequence[Any], scratch: Sequence[tuple[int, ...]], others: Sequence[Tensor]
) -> None:
    """Launch a kernel of sphere_cpu.py, some tiles after others: so scratch is small however large the picture is.

    scratch: shapes of the arrays between inputs and others, for each tile.
    """
    at_once, like = min(tiles, TILES_AT_ONCE), others[0]
    arrays = [like.new_empty(at_once, *shape) for shape in scratch]
    for first in range(0, tiles, at_once):
        arguments = first, *inputs, *arrays, *others
        launch(kernel, min(at_once, tiles - first), *arguments, min_range=1)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, caps, across, along, opacities, features, directions, lists: TileLists, alpha_threshold: float):
        width, height, channels = lists.width, lists.height, features.shape[1]
        splats = tuple(tensor.detach() for tensor in (caps, across, along, opacities, features))
        image, transmittance = features.new_empty(height, width, channels), features.new_empty(height, width)
        ends = torch.empty(height, width, dtype=torch.int32, device=image.device)
        ctx.lists, ctx.sizes = lists, (lists.grid.columns, width, height, alpha_threshold)
        ctx.kind = warp_scalar(features.dtype), channels
        ctx.inputs = lists.tile_ranges, lists.gaussians, directions.view(-1, 3)
        inputs, outputs = [*ctx.inputs, *splats, *ctx.sizes], [image.view(-1, channels), transmittance, ends]
        if image.is_cpu:
            highest = float(opacities.max()) if len(opacities) else 0.0
            ctx.kind = *ctx.kind, exp_squarings(alpha_threshold / max(highest, 1.0))
            kernel = sphere_cpu.forward_kernel(*ctx.kind)
            scratch = _DIRECTIONS, _CAPS, _ROWS, _ROWS, (channels, *_ROWS)
            _launch_by_tiles(kernel, lists.grid.tiles, inputs, scratch, outputs)
        else:
            kernel, arguments = sphere_kernels(*ctx.kind).blend, inputs + outputs
            launch(kernel, len(lists.tile_ranges) * _PIXELS, *arguments, min_range=_PIXELS)
        ctx.save_for_backward(caps, across, along, opacities, features, transmittance, ends)
        return image, transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image, grad_transmittance):
        *splats, transmittance, ends = ctx.saved_tensors
        lists, (count, channels) = ctx.lists, splats[-1].shape
        upstream = grad_image.contiguous().view(-1, channels), grad_transmittance.contiguous()
        inputs = [*ctx.inputs, *splats, *ctx.sizes]
        if grad_image.is_cpu:  # Each intersection has gradients, so that sums keep one order.
            gradients = grad_image.new_zeros(len(lists.emit_indices), channels + 10)
            scratch = _DIRECTIONS, _CAPS, _ROWS, _ROWS, (channels, *_ROWS), _ROWS, (channels, sphere_cpu.LANES)
            others = [transmittance, ends, lists.emit_indices, *upstream, gradients]
            _launch_by_tiles(sphere_cpu.backward_kernel(*ctx.kind), lists.grid.tiles, inputs, scratch, others)
            gradients = sum_by_gaussian(gradients, *lists.emit_order)
        else:
            gradients = grad_image.new_zeros(count, channels + 10)
            kernel = sphere_kernels(*ctx.kind).blend_backward
            arguments = [*inputs, transmittance, ends, lists.gaussians, *upstream, gradients]
            launch(kernel, len(lists.tile_ranges) * _PIXELS, *arguments)
        grad_axis, grad_across, grad_along, grad_opacity, grad_features = gradients.split((3, 3, 3, 1, channels), dim=1)
        grad_caps = torch.nn.functional.pad(grad_axis, (0, 1))
        return grad_caps, grad_across, grad_along, grad_opacity[:, 0], grad_features, None, None, None


class DirectionCaps(NamedTuple):
    """Caps around directions of blocks of pixels, by rows."""

    axes: Tensor  # [blocks, 3] mean direction of each block
    angles: Tensor  # [blocks, 2] cosine and sine of the largest angle to it


def caps_of(directions: Tensor, side: int) -> DirectionCaps:
    """Return caps of each side x side pixels of directions [H, W, 3]."""
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
    half = (chord / 2).clamp(max=1)  # Sine of half of the angle
    return DirectionCaps(axis.contiguous(), torch.stack([1 - 2 * half**2, 2 * half * (1 - half**2).sqrt()], dim=1))
