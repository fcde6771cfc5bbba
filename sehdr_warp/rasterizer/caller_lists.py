"""Blend 2D Gaussians over lists that the caller made, each for a square tile of any size, in the order of these lists.

The blend has tiles of TILE_SIZE. Where the caller's are smaller or do not line up, one such tile has pixels of several:
the image is then blended once for each place that a caller's tile can have in it, and each pixel is taken from its own.
"""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels.constants import ALPHA_MAX, ALPHA_THRESHOLD, TILE_SIZE, TRANSMITTANCE_MIN
from .absolute_gradient import watch_absolute_gradients
from .blending import blend
from .projection import Splats2D
from .tile_lists import EmitOrder, PackedSplats, TileLists, check_intersection_count, find_tile_ranges, pack_splats
from .tile_lists import tile_grid as grid_of

MAX_PAIRS = 1 << 22  # Of Gaussians and pixels that contributions() looks at together.


class CallerLists(NamedTuple):
    """Gaussians to draw in each tile of the caller, front to back."""

    tile_size: int  # Edge of a tile in pixels
    starts: Tensor  # [rows, columns] int64, where each tile's list begins
    ends: Tensor  # [rows, columns] int64, where it ends
    gaussians: Tensor  # [M] int64, the lists


def blend_caller_lists(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    features: Tensor,
    lists: CallerLists,
    width: int,
    height: int,
    store_absolute: Callable[[Tensor], None] | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the image [H, W, C] and the transmittance [H, W], differentiable with respect to the first four.

    A Gaussian that is not finite, whose conic is no ellipse or that stays below the threshold is not drawn.

    Args:
        means2d: [N, 2] centers in pixels.
        conics: [N, 3] a, b, c of the inverse covariance.
        opacities: [N].
        features: [N, C].
        lists: their tiles cover the image.
        width: of the image, pixels.
        height: of the image, pixels.
        store_absolute: called in the backward pass with [N, 2] to add up, as by watch_absolute_gradients().
    """
    means2d, conics, opacities, features = (each.contiguous() for each in (means2d, conics, opacities, features))
    extents = _extents(means2d, conics, opacities)
    splats = Splats2D(means2d, conics, torch.zeros_like(opacities), opacities, extents, features)
    visible = splats._replace(opacities=torch.where(extents[:, 0] > 0, opacities, 0.0).detach())
    packed = pack_splats(visible, ALPHA_THRESHOLD, 0, 0)  # No tiles: none are counted.
    size, image, transmittance = lists.tile_size, None, None
    places = product(range(_most_tiles(height, size)), range(_most_tiles(width, size)))
    x, y = (_place(torch.arange(length, device=means2d.device), size) for length in (width, height))
    for down, across in places:
        own = _own_lists(packed, lists, width, height, down, across)
        results = blend(splats, own, packed, ALPHA_THRESHOLD)
        if store_absolute is not None:
            results = watch_absolute_gradients(*results, features, own, packed, ALPHA_THRESHOLD, store_absolute)
        if image is None or transmittance is None:
            image, transmittance = results
        else:
            here = (y == down)[:, None] & (x == across)
            image = torch.where(here[..., None], results[0], image)
            transmittance = torch.where(here, results[1], transmittance)
    assert image is not None and transmittance is not None
    return image, transmittance


def _place(pixels: Tensor, size: int) -> Tensor:
    """Return which one of the caller's tiles in its own tile each pixel of an axis belongs to, from 0."""
    return pixels // size - pixels // TILE_SIZE * TILE_SIZE // size


def _most_tiles(length: int, size: int) -> int:
    """Return how many of the caller's tiles at most an own tile has pixels of, along an axis of `length` pixels."""
    return max(min(x + TILE_SIZE, length) - 1 - x // size * size for x in range(0, length, TILE_SIZE)) // size + 1


def _extents(means2d: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """Return half-widths and half-heights [N, 2] within which alpha reaches the threshold; 0 for what is not drawn.

    float32 leaves little of the determinant of a needle: its extents are larger here, or infinite.
    """
    with torch.no_grad():
        a, b, c = conics.double().unbind(1)
        rounding = 4 * torch.finfo(conics.dtype).eps
        relative = 1 - b * b / (a * c) - rounding  # The determinant over a c.
        cutoffs = 2 * torch.log((opacities.double() / ALPHA_THRESHOLD).clamp_min(1.0))
        extents = (cutoffs[:, None] / (torch.stack([a, c], 1) * relative.clamp_min(0.0)[:, None])).sqrt()
        finite = means2d.isfinite().all(1) & conics.isfinite().all(1) & opacities.isfinite()
        visible = finite & (a > 0) & (c > 0) & (relative > -2 * rounding) & (cutoffs > 0)
        return torch.where(visible[:, None], extents, 0.0).to(conics.dtype)


@torch.no_grad()
def _own_lists(packed: PackedSplats, lists: CallerLists, width: int, height: int, down: int, across: int) -> TileLists:
    """Return for each own tile the list of the caller's tile at a place in it, without what does not reach there."""
    grid, size, device = grid_of(width, height), lists.tile_size, packed.extents.device
    rows, columns = (torch.arange(count, device=device) * TILE_SIZE for count in (grid.rows, grid.columns))
    tile_rows, tile_columns = rows // size + down, columns // size + across
    exists = tile_rows * size < (rows + TILE_SIZE).clamp_max(height)
    exists = exists[:, None] & (tile_columns * size < (columns + TILE_SIZE).clamp_max(width))
    tiles = (tile_rows[:, None] * lists.starts.shape[1] + tile_columns)[exists]
    own = exists.flatten().nonzero()[:, 0]
    starts, counts = lists.starts.flatten()[tiles], (lists.ends - lists.starts).flatten()[tiles]
    nth = torch.arange(len(own), device=device).repeat_interleave(counts)
    entries = torch.arange(len(nth), device=device) + (starts - counts.cumsum(0) + counts)[nth]
    gaussians, keys = lists.gaussians[entries], own[nth]
    corners = torch.stack([keys % grid.columns, keys // grid.columns], 1) * TILE_SIZE
    centers, extents = packed.means_opacities[gaussians, :2], packed.extents[gaussians]
    distances = (centers - centers.maximum(corners).minimum(corners + TILE_SIZE)).abs()
    reached = ((extents > 0) & (distances <= extents)).all(1)
    gaussians, keys = gaussians[reached].int(), keys[reached].int()
    count, length = len(packed.depths), len(gaussians)
    check_intersection_count(length, count, grid)
    on_gpu = device.type == "cuda"
    ranges, masks = find_tile_ranges(keys, gaussians, packed if on_gpu else None, grid)
    emit_order = emit_indices = None
    if not on_gpu:  # Gradients are summed in the order of Gaussians.
        indices = torch.arange(max(count, length), dtype=torch.int32)
        emit_indices = torch.empty_like(gaussians)
        emit_indices[gaussians.argsort(stable=True)] = indices[:length]
        emit_order = EmitOrder(indices[:count], gaussians.bincount(minlength=count).cumsum(0))
    total = torch.tensor(length, device=device)
    return TileLists(ranges, gaussians, masks, emit_order, emit_indices, width, height, None, total)


@torch.no_grad()
def contributions(
    splats: tuple[Tensor, Tensor, Tensor], lists: CallerLists, transmittance: Tensor
) -> tuple[Tensor, Tensor]:
    """Return which Gaussians contribute to which pixels, [K] int64 each, by pixel and then by place in the list.

    splats: means2d [N, 2], conics [N, 3], opacities [N]. transmittance: [H, W] in front of the lists.
    """
    size, (height, width), device = lists.tile_size, transmittance.shape, transmittance.device
    lengths = (lists.ends - lists.starts).flatten()
    corners = torch.arange(size, device=device)
    pairs = [torch.zeros(2, 0, dtype=torch.int64, device=device)]
    order = lengths.argsort()[int((lengths <= 0).sum()) :]  # Tiles with lists of about one length together
    at = 0
    while at < len(order):
        tiles = order[at : at + 64]
        tiles = tiles[: max(1, MAX_PAIRS // (int(lengths[tiles[-1]]) * size * size))]
        at += len(tiles)
        nth = torch.arange(int(lengths[tiles[-1]]), device=device)
        listed = nth < lengths[tiles][:, None]
        entries = torch.where(listed, lists.starts.flatten()[tiles][:, None] + nth, 0)
        rows = lists.gaussians[entries]
        y = (tiles // lists.starts.shape[1] * size)[:, None, None] + corners[:, None]
        x = (tiles % lists.starts.shape[1] * size)[:, None, None] + corners
        y, x = (each.flatten(1)[:, None] for each in torch.broadcast_tensors(y, x))
        means2d, conics, opacities = (each[rows][:, :, None] for each in splats)
        dx, dy = means2d[..., 0] - x - 0.5, means2d[..., 1] - y - 0.5
        a, b, c = conics.unbind(-1)
        exponents = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alphas = (opacities * (-exponents).exp()).clamp_max(ALPHA_MAX)
        counts = (alphas > ALPHA_THRESHOLD) & (exponents >= 0) & listed[..., None] & (x < width) & (y < height)
        pixels = y.clamp_max(height - 1) * width + x.clamp_max(width - 1)
        left = torch.where(counts, 1 - alphas, 1.0).cumprod(1) * transmittance.flatten()[pixels]
        tile, place, pixel = (counts & (left > TRANSMITTANCE_MIN)).nonzero(as_tuple=True)
        pairs.append(torch.stack([rows[tile, place], pixels[tile, 0, pixel]]))
    gaussians, pixels = torch.cat(pairs, 1)
    order = pixels.argsort(stable=True)
    return gaussians[order], pixels[order]
