"""gsplat's functions and strategies (Ye et al. 2025, version 1.5) on sehdr-warp's kernels, on the CPU too.

A trainer written for gsplat imports them from here instead of from `gsplat`, `gsplat.rendering` and `gsplat.strategy`.
docs/gsplat.md lists for each argument whether it is the same, different or not supported.
"""

from .harmonics import spherical_harmonics
from .optimizers import SelectiveAdam
from .pixels import rasterize_to_indices_in_range, rasterize_to_pixels
from .projection import fully_fused_projection, quat_scale_to_covar_preci
from .relocation import compute_relocation
from .rendering import rasterization
from .splats import isect_offset_encode, isect_tiles
from .strategy import DefaultStrategy, MCMCStrategy, Strategy

__all__ = [
    "DefaultStrategy",
    "MCMCStrategy",
    "SelectiveAdam",
    "Strategy",
    "compute_relocation",
    "fully_fused_projection",
    "isect_offset_encode",
    "isect_tiles",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterize_to_indices_in_range",
    "rasterize_to_pixels",
    "spherical_harmonics",
]
