"""Enlargement of small pictures that belong to a photo, such as gain maps, with the photo as a guide.

Where the photo changes, the small picture usually changes with it, so a local linear model of the one by the other (He,
Sun and Tang, Guided Image Filtering, 2010) is fitted at the small size and applied at the photo's. What the model gets
wrong is added from the small picture, so that its averages stay.
"""

import numpy as np
from PIL import Image

from .lens import area_average

_RADIUS = 1.0  # Standard deviation of the neighborhood of a fit, in pixels of the small picture
_NOISE = 3e-4  # Variance of the guide's codes in [0, 1] below which it says little


def enlarge_guided(small: np.ndarray, guide: np.ndarray) -> np.ndarray:
    """Return a picture [h, w] float32 at the size of its guide [H, W], codes in [0, 1] of at least as many pixels."""
    height, width = small.shape
    reduced = area_average(guide, width, height)
    mean, mean_reduced = _blur(small), _blur(reduced)
    variance = np.maximum(_blur(reduced * reduced) - mean_reduced**2, 0) + np.float32(_NOISE)
    slope = (_blur(reduced * small) - mean_reduced * mean) / variance
    result = _enlarge(slope, guide) * guide + _enlarge(small - slope * reduced, guide)
    return result + _enlarge(small - area_average(result, width, height), guide)


def _blur(values: np.ndarray) -> np.ndarray:
    from scipy.ndimage import gaussian_filter  # Takes a second to load

    return gaussian_filter(values, _RADIUS, mode="nearest", truncate=3)


def _enlarge(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return [h, w] at the size of another array [H, W], by Catmull-Rom splines."""
    height, width = like.shape
    return np.asarray(Image.fromarray(values).resize((width, height), Image.Resampling.BICUBIC))
