"""The 2D Gaussians of all views of a call, the tiles that they touch, and the dictionary of rasterization()."""

import math
from collections.abc import Iterator, Mapping
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...rasterizer.checks import check_shape, check_tensors
from ...rasterizer.projection import ProjectedGaussians


class JoinedSplats(NamedTuple):
    """The 2D Gaussians of all views in joined tensors: [..., C, N, ...], or packed [nnz, ...].

    Attributes:
        all: the Gaussians.
        view_ids: [nnz] view of each packed Gaussian; None unless packed.
        gaussian_ids: [nnz] which Gaussians they are; None unless packed.
        rows: of each view, its index in what by_view() returns, or if packed the slice of its Gaussians.
    """

    all: ProjectedGaussians
    view_ids: Tensor | None
    gaussian_ids: Tensor | None
    rows: list[Any]

    @staticmethod
    def of(views: list[ProjectedGaussians], packed: bool, shape: tuple[int, ...]) -> "JoinedSplats":
        """Join the views, whose axes are `shape`. The gradient of the joined means2d then holds every view's."""
        if not packed:
            joined = ProjectedGaussians(*(torch.stack(each).unflatten(0, shape) for each in zip(*views, strict=True)))
            return JoinedSplats(joined, None, None, list(range(len(views))))
        visible = [(view.extents > 0).all(1).nonzero()[:, 0] for view in views]
        joined = ProjectedGaussians(
            *(
                torch.cat([tensor[mine] for tensor, mine in zip(each, visible, strict=True)])
                for each in zip(*views, strict=True)
            )
        )
        counts = [len(mine) for mine in visible]
        device = joined.means2d.device
        view_ids = torch.arange(len(views), device=device).repeat_interleave(torch.tensor(counts, device=device))
        rows = [slice(*ends) for ends in pairwise(accumulate(counts, initial=0))]
        return JoinedSplats(joined, view_ids, torch.cat(visible), rows)

    @property
    def radii(self) -> Tensor:
        """Return half-extents in whole pixels, int32; those above 2^30 as 2^30."""
        return self.all.extents.ceil().clamp_max(1 << 30).int()

    def ids(self, cameras: int) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        """Return batch_ids, camera_ids and gaussian_ids, [nnz] each; None unless packed."""
        if self.view_ids is None:
            return None, None, None
        return self.view_ids // cameras, self.view_ids % cameras, self.gaussian_ids

    def by_view(self, tensor: Tensor) -> Tensor:
        """Return a joined tensor with one axis of views, or as it is if packed."""
        return tensor if self.gaussian_ids is not None else tensor.flatten(0, self.all.depths.ndim - 2)

    def of_view(self, view: int) -> ProjectedGaussians:
        """Return the Gaussians of one view."""
        projected = ProjectedGaussians(*(self.by_view(tensor)[self.rows[view]] for tensor in self.all))
        # A copy of the extents, because rendering sets some to 0 in place.
        return projected._replace(extents=projected.extents.clone())


class Meta(dict[str, Any]):
    """A dictionary whose values are computed, if they are functions, when they are first read."""

    # They read self[key].
    get, items, values = Mapping.get, Mapping.items, Mapping.values  # pyright: ignore[reportAssignmentType]

    def __getitem__(self, key: str) -> Any:
        """Return the value of a key; compute it first if that is due."""
        value = super().__getitem__(key)
        if callable(value):
            value()
            value = super().__getitem__(key)
        return value

    def __iter__(self) -> Iterator[str]:
        """Iterate over keys. With a method of its own, dict(meta) and {**meta} read values as meta[key] does."""
        return super().__iter__()

    def pop(self, key: str, *default: Any) -> Any:
        """Remove a key and return its value, or the default without it."""
        self.get(key)
        return super().pop(key, *default)

    def copy(self) -> dict[str, Any]:
        """Return a plain dictionary of all values."""
        return dict(self)

    def __or__(self, other: Any) -> dict[str, Any]:
        """Return a plain dictionary of all values and another's."""
        return dict(self) | other

    def __reduce__(self) -> Any:
        """Pickle and copy as a plain dictionary, which is read without this package."""
        return dict, (dict(self),)


def make_meta(splats: JoinedSplats, shape: tuple[int, ...], size: tuple[int, int], tile_size: int) -> dict[str, Any]:
    """Return gsplat's `meta` for views with axes `shape` and images of `size` (width, height)."""
    width, height = size
    cameras, images = shape[-1], math.prod(shape)
    tile_width, tile_height = -(-width // tile_size), -(-height // tile_size)
    batch_ids, camera_ids, gaussian_ids = splats.ids(cameras)
    radii = splats.radii

    def compute_intersections() -> None:
        means2d, depths = splats.by_view(splats.all.means2d), splats.by_view(splats.all.depths)
        counts, isect_ids, flatten_ids = isect_tiles(
            means2d, splats.by_view(radii), depths, tile_size, tile_width, tile_height, image_ids=splats.view_ids
        )
        offsets = isect_offset_encode(isect_ids, images, tile_width, tile_height)
        meta.update(
            tiles_per_gauss=counts.reshape(splats.all.depths.shape),
            isect_ids=isect_ids,
            flatten_ids=flatten_ids,
            isect_offsets=offsets.unflatten(0, shape),
        )

    meta = Meta(
        batch_ids=batch_ids,
        camera_ids=camera_ids,
        gaussian_ids=gaussian_ids,
        radii=radii,
        means2d=splats.all.means2d,
        depths=splats.all.depths,
        conics=splats.all.conics,
        opacities=splats.all.opacities,
        tile_width=tile_width,
        tile_height=tile_height,
        tiles_per_gauss=compute_intersections,
        isect_ids=compute_intersections,
        flatten_ids=compute_intersections,
        isect_offsets=compute_intersections,
        width=width,
        height=height,
        tile_size=tile_size,
        n_batches=images // cameras,
        n_cameras=cameras,
    )
    return meta


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the tiles that the bounding rectangles of 2D Gaussians touch.

    Args:
        means2d: [..., N, 2] or, packed, [nnz, 2].
        radii: [..., N, 2] or [nnz, 2] int32.
        depths: [..., N] or [nnz], positive.
        tile_size: in pixels.
        tile_width: tiles across.
        tile_height: tiles down.
        sort: whether to sort by image, tile and depth.
        segmented: has no effect.
        packed: whether inputs are packed.
        n_images: has no effect beside image_ids.
        image_ids: [nnz] if packed.
        gaussian_ids: has no effect.

    Returns:
        tiles_per_gauss [..., N] or [nnz] int32; isect_ids [M] int64, in bits from the highest: image, tile, 32 bits of
        the depth; flatten_ids [M] int32, the index in the flattened inputs.

    Raises:
        TypeError: for what is not a tensor.
        ValueError: for shapes, dtypes or devices that do not fit.
    """
    batch = tuple(depths.shape[:-1]) if isinstance(depths, Tensor) else ()
    check_tensors(depths=(depths, (*batch, "N")), means2d=(means2d, (*batch, "N", 2)))
    check_shape("radii", radii, means2d.shape)
    shape = depths.shape
    if image_ids is None:
        images = math.prod(shape[:-1])
        image_ids = torch.arange(images, device=depths.device).repeat_interleave(shape[-1]).reshape(-1)
    centers, reach, depths = means2d.detach().reshape(-1, 2), radii.reshape(-1, 2), depths.detach().reshape(-1)
    limits = torch.tensor([tile_width, tile_height], device=centers.device)
    low = ((centers - reach) / tile_size).floor().clamp_min(0).minimum(limits).long()
    high = ((centers + reach) / tile_size).ceil().clamp_min(0).minimum(limits).long()
    spans = torch.where((reach > 0).all(1, keepdim=True), (high - low).clamp_min(0), 0)
    counts = spans.prod(1)
    flatten_ids = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    places = torch.arange(len(flatten_ids), device=counts.device) - (counts.cumsum(0) - counts)[flatten_ids]
    across = spans[flatten_ids, 0].clamp_min(1)
    tiles = (low[flatten_ids, 1] + places // across) * tile_width + low[flatten_ids, 0] + places % across
    bits = depths.float().view(torch.int32).long() & 0xFFFFFFFF
    keys = (image_ids[flatten_ids] << (tile_width * tile_height).bit_length()) | tiles
    isect_ids = (keys << 32) | bits[flatten_ids]
    if sort:
        isect_ids, order = isect_ids.sort(stable=True)
        flatten_ids = flatten_ids[order]
    return counts.int().reshape(shape), isect_ids, flatten_ids.int()


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Return [C, tile_height, tile_width] int32: where each tile's intersections begin among sorted isect_ids."""
    tiles = torch.arange(n_images * tile_width * tile_height, device=isect_ids.device)
    image, tile = tiles // (tile_width * tile_height), tiles % (tile_width * tile_height)
    keys = (image << (tile_width * tile_height).bit_length()) | tile
    offsets = torch.searchsorted((isect_ids >> 32).contiguous(), keys)
    return offsets.int().reshape(n_images, tile_height, tile_width)
