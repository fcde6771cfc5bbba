"""gsplat's rasterize_to_pixels() and rasterize_to_indices_in_range(): images of lists of tiles that the caller made."""

from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...rasterizer.caller_lists import CallerLists, blend_caller_lists, contributions
from ...rasterizer.checks import check_shape, check_tensors, integer
from ...rasterizer.memory import oom_context
from ...rasterizer.render_options import MAX_SIDE, image_size
from ...rasterizer.torch_contract import torch_operation


@torch_operation
def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Blend 2D Gaussians to images, in each tile those that its list names, in the order of the list.

    Args:
        means2d: [..., N, 2] in pixels; "..." are the axes of the images. Packed: [nnz, 2].
        conics: [..., N, 3] or [nnz, 3]: a, b, c of the inverse covariances.
        colors: [..., N, D] or [nnz, D], any D from 1.
        opacities: [..., N] or [nnz].
        image_width: of the images, pixels.
        image_height: of the images, pixels.
        tile_size: edge of a tile, pixels.
        isect_offsets: [..., tile_height, tile_width] int32 or int64: where each tile's list begins in flatten_ids. It
            ends where the next one begins.
        flatten_ids: [M] int32 or int64: rows of the flattened Gaussians, [... N] or [nnz].
        backgrounds: [..., D], or [D] for all images.
        masks: [..., tile_height, tile_width] bool: False for tiles that show the background alone.
        packed: whether the Gaussians of all images are rows; those of [nnz, 2] always are.
        absgrad: the backward pass sets means2d.absgrad, the sums over pixels of absolute gradients.

    Returns:
        Colors [..., H, W, D] and alphas [..., H, W, 1], where "..." are the axes of isect_offsets.

    Raises:
        TypeError: for what is not a tensor or not an integer.
        ValueError: for shapes, dtypes, devices or indices that do not fit.
    """
    width, height, size = _check_sizes(image_width, image_height, tile_size)
    batch = tuple(means2d.shape[:-2]) if isinstance(means2d, Tensor) and not packed else ()
    tensors: dict[str, Any] = {
        "means2d": (means2d, (*batch, "N", 2)),
        "conics": (conics, (*batch, "N", 3)),
        "colors": (colors, (*batch, "N", "D")),
        "opacities": (opacities, (*batch, "N")),
    }
    axes = _check_offsets(isect_offsets, batch, size, width, height)
    if backgrounds is not None:
        is_shared = isinstance(backgrounds, Tensor) and backgrounds.ndim == 1
        tensors["backgrounds"] = (backgrounds, (*(() if is_shared else axes), "D"))
    check_tensors(**tensors)
    if not colors.shape[-1]:
        raise ValueError(f"colors has shape {list(colors.shape)}, which has no channel")
    _check_indices(means2d, isect_offsets, flatten_ids, masks)

    with oom_context(means2d.device, lambda: (opacities.numel(), width, height, colors.shape[-1])):
        rows = [
            tensor.reshape(-1, *tensor.shape[tensor.ndim - own :])
            for tensor, own in ((means2d, 1), (conics, 1), (opacities, 0), (colors, 1))
        ]
        lists = _lists_of_images(isect_offsets, flatten_ids, masks, size, opacities.numel())
        behind = None if backgrounds is None else backgrounds.expand(*axes, -1).reshape(-1, colors.shape[-1])
        absolute = _AbsoluteGradients(means2d) if absgrad and means2d.requires_grad else None
        images, alphas = [], []
        for index, (first, last, own) in enumerate(lists):
            store = None if absolute is None else partial(absolute.add, slice(first, last))
            centers, ellipses, alpha, features = (tensor[first:last] for tensor in rows)
            image, transmittance = blend_caller_lists(centers, ellipses, alpha, features, own, width, height, store)
            if behind is not None:
                image = image + transmittance[..., None] * behind[index]
            images.append(image)
            alphas.append(1.0 - transmittance[..., None])
        results = torch.stack(images), torch.stack(alphas)
        for result in results:  # Not of the views that are returned: a change in place would lose the hook.
            if absolute is not None and result.requires_grad:
                result.register_hook(absolute.begin)
        return results[0].reshape(axes + results[0].shape[1:]), results[1].reshape(axes + results[1].shape[1:])


class _Sizes(NamedTuple):
    """Sizes of the images and of their tiles, pixels."""

    width: int
    height: int
    tile: int


def _check_sizes(width: Any, height: Any, tile: Any) -> _Sizes:
    """Return image_width, image_height and tile_size as integers; raise an error for others."""
    values = {"image_width": width, "image_height": height, "tile_size": tile}
    sizes = _Sizes(*(integer(name, value, 1, MAX_SIDE) for name, value in values.items()))
    image_size(sizes.width, sizes.height)
    return sizes


def _check_offsets(offsets: Any, batch: tuple[int, ...], size: int, width: int, height: int) -> tuple[int, ...]:
    """Return the axes of images; raise TypeError or ValueError for offsets that do not fit."""
    if not isinstance(offsets, Tensor):
        raise TypeError(
            f"isect_offsets is a {type(offsets).__name__}, expected a tensor [..., tile_height, tile_width]"
        )
    *axes, rows, columns = offsets.shape if offsets.ndim > 1 else (0, *offsets.shape, 0)[:3]
    if offsets.ndim < 2 or (batch and tuple(axes) != batch):
        expected = ", ".join([*(map(str, batch) if batch else ["..."]), "tile_height", "tile_width"])
        raise ValueError(f"isect_offsets has shape {list(offsets.shape)}, expected [{expected}]")
    if 0 in axes:
        raise ValueError(f"isect_offsets has shape {list(offsets.shape)}, which has no image")
    if rows * size < height or columns * size < width:
        raise ValueError(
            f"isect_offsets has {columns} x {rows} tiles of tile_size {size}, which do not cover an image of "
            f"{width} x {height} pixels"
        )
    return tuple(axes)


def _check_indices(means2d: Tensor, offsets: Tensor, flatten_ids: Any, masks: Any) -> None:
    """Raise TypeError or ValueError for shapes, dtypes or devices of indices and masks that do not fit."""
    if not isinstance(flatten_ids, Tensor):
        raise TypeError(f"flatten_ids is a {type(flatten_ids).__name__}, expected a tensor [M]")
    check_shape("flatten_ids", flatten_ids, [flatten_ids.numel()])
    indices = {"isect_offsets": offsets, "flatten_ids": flatten_ids}
    if masks is not None:
        check_shape("masks", masks, offsets.shape)
        indices["masks"] = masks
    for name, tensor in indices.items():
        expected = (torch.bool,) if name == "masks" else (torch.int32, torch.int64)
        if tensor.dtype not in expected:
            raise ValueError(f"{name} is {tensor.dtype}, expected {' or '.join(map(str, expected))}")
        if tensor.device != means2d.device:
            raise ValueError(f"{name} is on {tensor.device}, but means2d is on {means2d.device}")


def _lists_of_images(
    offsets: Tensor, flatten_ids: Tensor, masks: Tensor | None, size: int, count: int
) -> list[tuple[int, int, CallerLists]]:
    """Return for each image the lowest row that its lists name, one past the highest, and lists of rows between them.

    Raises ValueError for offsets that fall, and for rows out of range of the `count` that there are.
    """
    total, ids = len(flatten_ids), flatten_ids.long()
    starts = offsets.flatten().long()
    ends = torch.cat([starts[1:], starts.new_full((1,), total)])
    first = starts.reshape(-1, offsets.shape[-2] * offsets.shape[-1])[:, 0]
    fall, lowest, *firsts = torch.cat([(ends - starts).amin()[None], starts[:1], first]).tolist()
    if fall < 0 or lowest < 0:
        raise ValueError(f"isect_offsets has numbers that fall or are not from 0 to {total}, the length of flatten_ids")
    if masks is not None:
        ends = torch.where(masks.flatten(), ends, starts)
    tiles = zip(*(each.reshape(-1, *offsets.shape[-2:]) for each in (starts, ends)), strict=True)
    lists = []
    for begin, end, (own_starts, own_ends) in zip(firsts, [*firsts[1:], total], tiles, strict=True):
        low, high = torch.stack(ids[begin:end].aminmax()).tolist() if end > begin else (0, -1)
        if low < 0 or high >= count:
            raise ValueError(f"flatten_ids has numbers from {low} to {high}, expected 0 and up, below {count}")
        lists.append((low, high + 1, CallerLists(size, own_starts, own_ends, ids - low)))
    return lists


@torch_operation
@torch.no_grad()
def rasterize_to_indices_in_range(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return which Gaussians each pixel shows, front to back: of each tile's list a range of batches.

    Args:
        range_start: first batch, of tile_size^2 Gaussians of a list.
        range_end: one past the last batch.
        transmittances: [..., H, W] before the first batch.
        means2d: [..., N, 2]; this and the others as rasterize_to_pixels() takes them.
        conics: [..., N, 3].
        opacities: [..., N].
        image_width: pixels.
        image_height: pixels.
        tile_size: pixels.
        isect_offsets: [..., tile_height, tile_width].
        flatten_ids: [M].

    Returns:
        Gaussians (0 to N - 1), pixels (row by row) and images, [K] int64 each, by image, pixel and place in the list.

    Raises:
        TypeError: for what is not a tensor or not an integer.
        ValueError: for shapes, dtypes, devices or indices that do not fit.
    """
    width, height, size = _check_sizes(image_width, image_height, tile_size)
    batches = {"range_start": range_start, "range_end": range_end}
    batch = tuple(means2d.shape[:-2]) if isinstance(means2d, Tensor) else ()
    axes = _check_offsets(isect_offsets, batch, size, width, height)
    check_tensors(
        means2d=(means2d, (*batch, "N", 2)),
        conics=(conics, (*batch, "N", 3)),
        opacities=(opacities, (*batch, "N")),
        transmittances=(transmittances, (*axes, height, width)),
    )
    _check_indices(means2d, isect_offsets, flatten_ids, None)
    total, parts = len(flatten_ids), []
    left, right = (min(integer(name, value, 0, 1 << 62) * size**2, total) for name, value in batches.items())
    lists = _lists_of_images(isect_offsets, flatten_ids, None, size, opacities.numel())
    splats = means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.reshape(-1)
    for image, (first, _, own) in enumerate(lists):
        starts, ends = (own.starts + left).minimum(own.ends), (own.starts + right).minimum(own.ends)
        before = transmittances.reshape(-1, height, width)[image]
        rows, pixels = contributions(
            splats, own._replace(starts=starts, ends=ends, gaussians=own.gaussians + first), before
        )
        parts.append(torch.stack([rows % max(means2d.shape[-2], 1), pixels, torch.full_like(rows, image)]))
    gaussians, pixels, images = torch.cat(parts, 1)
    return gaussians, pixels, images


class _AbsoluteGradients:
    """Sums absolute gradients over images, anew in each backward pass, and sets them as means2d.absgrad."""

    def __init__(self, means2d: Tensor) -> None:
        """Sum for the rows of `means2d` [..., 2]."""
        self._means2d = means2d
        self._sums: Tensor

    def begin(self, _: Tensor) -> None:
        """Begin a backward pass: called before any image's."""
        self._sums = torch.zeros_like(self._means2d, memory_format=torch.contiguous_format)
        self._means2d.absgrad = self._sums  # pyright: ignore[reportAttributeAccessIssue]

    def add(self, rows: slice, gradients: Tensor) -> None:
        """Add the absolute gradients [n, 2] of an image to rows of the flattened Gaussians."""
        self._sums.view(-1, 2)[rows] += gradients
