"""torch <-> Warp: differentiable splatting and the bridge that makes torch operations of Warp programs."""

from .blend_style import BlendStyle
from .bridge import Program, differentiable
from .exploration import add_exploration_noise
from .harmonics import spherical_harmonics
from .neighbours import nearest_neighbour_distances
from .rasterization import Rendering, rasterize
from .recorded_rasterizer import RecordedRasterizer
from .recording import GraphRecorder
from .ssim import ssim, ssim_map

__all__ = [
    "BlendStyle",
    "GraphRecorder",
    "Program",
    "RecordedRasterizer",
    "Rendering",
    "add_exploration_noise",
    "differentiable",
    "nearest_neighbour_distances",
    "rasterize",
    "spherical_harmonics",
    "ssim",
    "ssim_map",
]
