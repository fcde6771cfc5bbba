"""Differentiable splatting as torch operations of Warp kernels, and a bridge for kernels of users.

- rasterization.py: rasterize(), by projection.py, tile_lists.py and blending.py (on a GPU blending_cuda.py).
- sphere.py: rasterize_directions(). caller_lists.py: tile lists of a caller. reference.py: rasterize() in plain torch.
- checks.py, render_options.py: arguments.
- cuda_graphs/: renders that repeat, replayed. losses/: SSIM and residuals. ops/: other operations.
- bridge.py, custom_ops.py, torch_contract.py: kernels of users, torch.compile, and what torch expects of an operation.
- warp_launch/: launches of kernels on torch tensors. precompile.py: kernels that a training will need.
"""

from . import custom_ops as custom_ops  # Registers what torch.compile calls in place of the operations.
from .bridge import Program, differentiable
from .cuda_graphs.runner import CudaGraphRunner
from .losses.ssim import ssim, ssim_map
from .ops.harmonics import HarmonicsGradients, spherical_harmonics
from .rasterization import Rendering, rasterize
from .sphere import rasterize_directions

__all__ = [
    "CudaGraphRunner",
    "HarmonicsGradients",
    "Program",
    "Rendering",
    "differentiable",
    "rasterize",
    "rasterize_directions",
    "spherical_harmonics",
    "ssim",
    "ssim_map",
]
