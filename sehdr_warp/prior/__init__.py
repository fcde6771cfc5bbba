"""A learned prior for light above white: what clipped pixels probably hold, from everything else in a photo."""

from .estimate import LightEstimate, LightPrior, load_prior

__all__ = ["LightEstimate", "LightPrior", "load_prior"]
