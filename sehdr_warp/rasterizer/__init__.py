"""torch <-> Warp: differentiable splatting and the bridge that makes torch operations of Warp programs."""

from .bridge import Program, differentiable
from .harmonics import HarmonicsGradients, spherical_harmonics
from .rasterization import Rendering, rasterize
from .recording import GraphRecorder
from .sphere import rasterize_directions
from .ssim import ssim, ssim_map

__all__ = [
    "GraphRecorder",
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
