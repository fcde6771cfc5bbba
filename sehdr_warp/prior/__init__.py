"""A learned prior for light above white: what clipped pixels probably hold, from everything else in a photo."""

from .estimate import ClippedLight, LightEstimate, LightPrior, coarse_size, combined_estimates, load_prior

__all__ = ["ClippedLight", "LightEstimate", "LightPrior", "coarse_size", "combined_estimates", "load_prior"]
