"""The options of a rendered image, and their ranges."""

import math
from typing import Any, NamedTuple

import torch

from ..kernels.constants import ALPHA_THRESHOLD, EPS2D, NEAR_PLANE
from .checks import boolean, check_render_options, integer, is_not_negative, real
from .cuda_graphs.runner import is_capturing

MAX_INTERSECTIONS = 2**31 - 1  # They are counted in int32.
MAX_SIDE = 1 << 20  # Of an image, in pixels.


def image_size(width: Any, height: Any) -> tuple[int, int]:
    """Return the sides of an image as plain integers; raise TypeError or ValueError for sizes out of range."""
    width, height = integer("width", width, 1, MAX_SIDE), integer("height", height, 1, MAX_SIDE)
    if width * height >= 1 << 31:  # Kernels number pixels in int32.
        raise ValueError(f"an image of {width} x {height} has 2^31 pixels or more; render parts of it")
    return width, height


class RenderOptions(NamedTuple):
    """The arguments of rasterize() that are not tensors."""

    width: int
    height: int
    near_plane: float = NEAR_PLANE
    eps2d: float = EPS2D
    alpha_threshold: float = ALPHA_THRESHOLD
    antialiased: bool = False
    depth: bool = False
    max_intersections: int | None = None
    deterministic: bool = False
    ray_limit_x: float = math.inf
    ray_limit_y: float = math.inf

    def checked(self, device: torch.device) -> "RenderOptions":
        """Return the options as Python's types; raise TypeError or ValueError for values out of range."""
        limit = self.max_intersections
        if limit is not None:
            limit = integer("max_intersections", limit, 1, MAX_INTERSECTIONS)
        elif is_capturing(device):
            raise RuntimeError(
                "rasterize() waits for the GPU to learn how much memory it needs, which a CUDA graph cannot; "
                "give max_intersections"
            )
        real("eps2d", self.eps2d, is_not_negative, "a number from 0")
        for name in ("ray_limit_x", "ray_limit_y"):
            real(name, getattr(self, name), lambda number: number > 0, "above 0")
        check_render_options(self.near_plane, self.alpha_threshold)
        flags = {name: boolean(name, getattr(self, name)) for name in ("antialiased", "depth", "deterministic")}
        width, height = image_size(self.width, self.height)
        return self._replace(width=width, height=height, max_intersections=limit, **flags)
