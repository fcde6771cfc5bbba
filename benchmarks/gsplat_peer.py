"""gsplat (Ye et al. 2025) beside us, where it is installed and there is a GPU: its rasterizer in our place."""

import importlib.util
from collections.abc import Callable
from typing import Any

import torch

from sehdr_warp.kernels.constants import EPS2D
from sehdr_warp.rasterizer import Rendering

from .splats import SplatScene

GSPLAT = "gsplat"
BOUND = 1e-3
"""Largest relative difference of its image, or of a step's loss with it, from ours."""


def note_missing(result: dict, device: torch.device) -> bool:
    """Return whether gsplat can run here; a note in the result says why not."""
    if device.type != "cuda":
        result["notes"].append("gsplat not compared: it needs CUDA")
        return False
    if importlib.util.find_spec("gsplat") is None:
        result["notes"].append("gsplat not compared: not installed (pip install gsplat==1.5.3)")
        return False
    return True


def rasterize_with_gsplat(
    means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics, width: int, height: int, *,
    eps2d: float = EPS2D, antialiased: bool = False, max_intersections: int | None = None, deterministic: bool = False,
) -> Rendering:  # fmt: skip
    """Do rasterize() by gsplat, also with intrinsics as gsplat takes them, [1, 3, 3].

    max_intersections and deterministic have no effect. There is no transmittance, and densification by gradients cannot
    watch gsplat's centers.
    """
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    matrix = intrinsics if intrinsics.ndim == 3 else _matrix(intrinsics)
    image, _, info = rasterization(
        means, quaternions, log_scales.exp(), opacities, features, world_to_camera[None], matrix, width, height,
        packed=False, rasterize_mode="antialiased" if antialiased else "classic", eps2d=eps2d,
    )  # fmt: skip
    # gsplat 1.5 gives two radii, its forerunners one.
    radii = info["radii"][0].float()
    extents = radii if radii.ndim == 2 else radii[:, None].expand(-1, 2)
    unknown: Any = None
    return Rendering(image[0], unknown, info["means2d"][0], info["depths"][0], extents, 0)


def _matrix(intrinsics: torch.Tensor) -> torch.Tensor:
    """[1, 3, 3] of fx, fy, cx, cy."""
    fx, fy, cx, cy = intrinsics
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(1, 3, 3)


def gsplat_renderer(scene: SplatScene) -> Callable[[], torch.Tensor]:
    """Return a function that renders [H, W, C]; what does not change between calls is prepared."""
    arguments: Any = (
        *scene.leaves,
        scene.world_to_camera,
        _matrix(scene.intrinsics),
        scene.size.width,
        scene.size.height,
    )
    return lambda: rasterize_with_gsplat(*arguments).image
