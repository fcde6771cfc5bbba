"""torch <-> Warp: differentiable splatting and the bridge that makes torch operations of Warp programs."""

from .bridge import Program, differentiable
from .harmonics import spherical_harmonics
from .rasterization import Rendering, rasterize

__all__ = ["Program", "Rendering", "differentiable", "rasterize", "spherical_harmonics"]
