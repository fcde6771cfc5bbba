"""The 2D Gaussians of all views of a call, and the dictionary that rasterization() returns of them."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...rasterizer.projection import ProjectedGaussians
from .projection import isect_offset_encode, isect_tiles


class ViewSplats(NamedTuple):
    """The 2D Gaussians of one view.

    Attributes:
        projected: the Gaussians.
        rows: index of the view in what JoinedSplats.by_view() returns, or if packed the slice of its Gaussians.
        gaussian_ids: which Gaussians they are; None unless packed.
    """

    projected: ProjectedGaussians
    rows: Any
    gaussian_ids: Tensor | None


class JoinedSplats(NamedTuple):
    """The 2D Gaussians of all views in joined tensors: [..., C, N, ...], or packed [nnz, ...]."""

    all: ProjectedGaussians
    view_ids: Tensor | None
    gaussian_ids: Tensor | None
    splits: list[int]

    @staticmethod
    def of(views: list[ProjectedGaussians], packed: bool, shape: tuple[int, ...]) -> "JoinedSplats":
        """Join the views, whose axes are `shape`. The gradient of the joined means2d then holds every view's."""
        if not packed:
            joined = ProjectedGaussians(*(torch.stack(each).unflatten(0, shape) for each in zip(*views, strict=True)))
            return JoinedSplats(joined, None, None, [])
        rows = [(view.extents > 0).all(1).nonzero()[:, 0] for view in views]
        joined = ProjectedGaussians(
            *(
                torch.cat([tensor[mine] for tensor, mine in zip(each, rows, strict=True)])
                for each in zip(*views, strict=True)
            )
        )
        counts = [len(mine) for mine in rows]
        device = views[0].means2d.device
        view_ids = torch.arange(len(views), device=device).repeat_interleave(torch.tensor(counts, device=device))
        return JoinedSplats(joined, view_ids, torch.cat(rows), counts)

    def by_view(self, tensor: Tensor) -> Tensor:
        """Return a joined tensor with one axis of views, or as it is if packed."""
        return tensor if self.gaussian_ids is not None else tensor.flatten(0, self.all.depths.ndim - 2)

    def of_view(self, place: int) -> ViewSplats:
        """Return the Gaussians of one view."""
        start = sum(self.splits[:place])
        rows: Any = place if self.gaussian_ids is None else slice(start, start + self.splits[place])
        projected = ProjectedGaussians(*(self.by_view(tensor)[rows] for tensor in self.all))
        # A copy of the extents, because rendering sets some to 0 in place.
        projected = projected._replace(extents=projected.extents.clone())
        return ViewSplats(projected, rows, None if self.gaussian_ids is None else self.gaussian_ids[rows])


class Meta(dict[str, Any]):
    """A dictionary whose values are computed, if they are functions, when they are first read."""

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

    def copy(self) -> dict[str, Any]:
        """Return a plain dictionary of all values."""
        return dict(self.items())

    def __or__(self, other: Any) -> dict[str, Any]:
        """Return a plain dictionary of all values and another's."""
        return self.copy() | other

    def pop(self, key: str, *default: Any) -> Any:
        """Remove a key and return its value, or the default without it."""
        if key in self:
            self[key]
        return super().pop(key, *default)

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value of a key, or the default without it."""
        try:
            return self[key]
        except KeyError:
            return default

    def items(self) -> Any:
        """Return keys and values."""
        return [(key, self[key]) for key in self]

    def values(self) -> Any:
        """Return values."""
        return [self[key] for key in self]

    def __reduce__(self) -> Any:
        """Pickle as a plain dictionary."""
        return dict, (dict(self.items()),)


def make_meta(splats: JoinedSplats, shape: tuple[int, ...], size: tuple[int, int], tile_size: int) -> dict[str, Any]:
    """Return gsplat's `meta` for views with axes `shape` and images of `size` (width, height)."""
    width, height = size
    cameras, images = shape[-1], math.prod(shape)
    tile_width, tile_height = -(-width // tile_size), -(-height // tile_size)
    view_ids, radii = splats.view_ids, splats.all.extents.ceil().int()

    def compute_intersections() -> None:
        means2d, depths = splats.by_view(splats.all.means2d), splats.by_view(splats.all.depths)
        counts, isect_ids, flatten_ids = isect_tiles(
            means2d, splats.by_view(radii), depths, tile_size, tile_width, tile_height, image_ids=view_ids
        )
        offsets = isect_offset_encode(isect_ids, images, tile_width, tile_height)
        meta.update(
            tiles_per_gauss=counts.reshape(splats.all.depths.shape),
            isect_ids=isect_ids,
            flatten_ids=flatten_ids,
            isect_offsets=offsets.unflatten(0, shape),
        )

    meta = Meta(
        batch_ids=None if view_ids is None else view_ids // cameras,
        camera_ids=None if view_ids is None else view_ids % cameras,
        gaussian_ids=splats.gaussian_ids,
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
