"""Differentiable splatting as torch operations of Warp kernels, and a bridge for kernels of users."""

from . import custom_ops as custom_ops  # Registers what torch.compile calls in place of the operations.
from .bridge import Program, differentiable
from .cuda_graphs import CudaGraphRunner
from .harmonics import HarmonicsGradients, spherical_harmonics
from .rasterization import Rendering, rasterize
from .sphere import rasterize_directions
from .ssim import ssim, ssim_map

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
