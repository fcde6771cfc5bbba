"""gsplat (Ye et al. 2025) beside us, where it is installed and there is a GPU."""

import importlib.util
from collections.abc import Callable

import torch

from sehdr_warp.kernels.constants import EPS2D

from .splats import SplatScene

GSPLAT = "gsplat"
BOUND = 1e-3  # Largest relative difference of its image from ours


def note_missing(result: dict, device: torch.device) -> bool:
    """Return whether gsplat can run here; a note in the result says why not."""
    if device.type != "cuda":
        result["notes"].append("gsplat not compared: it needs CUDA")
        return False
    if importlib.util.find_spec("gsplat") is None:
        result["notes"].append("gsplat not compared: not installed (pip install gsplat==1.5.3)")
        return False
    return True


def gsplat_renderer(scene: SplatScene) -> Callable[[], torch.Tensor]:
    """Return a function that renders [H, W, C]; what does not change between calls is prepared."""
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    means, log_scales, quaternions, opacities, features = scene.leaves
    fx, fy, cx, cy = scene.intrinsics.tolist()
    matrix = torch.tensor([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]], device=scene.device)
    options = {"packed": False, "rasterize_mode": "classic", "eps2d": EPS2D}
    camera = scene.world_to_camera[None], matrix, scene.size.width, scene.size.height
    return lambda: rasterization(means, quaternions, log_scales.exp(), opacities, features, *camera, **options)[0][0]
