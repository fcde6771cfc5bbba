"""Enlargement of small pictures that belong to a photo, such as gain maps and chroma, with the photo as a guide.

Where the photo changes, the small picture usually changes with it, so a local linear model of the one by the other (He,
Sun and Tang, Guided Image Filtering, 2010) is fitted at the small size and applied at the photo's. What the model gets
wrong is added from the small picture, so that its averages stay.
"""

from collections.abc import Callable

import numpy as np

_RADIUS = 1.0  # Standard deviation of the neighborhood of a fit, in pixels of the small picture
_NOISE = 3e-4  # Variance of the guide's codes in [0, 1] below which it says little


def enlarge_guided(
    small: np.ndarray,
    guide: np.ndarray,
    *,
    reduce: Callable[[np.ndarray], np.ndarray],
    enlarge: Callable[[np.ndarray], np.ndarray],
    trusted: float = 0.0,
) -> np.ndarray:
    """Return a picture [h, w] float32 at the size of its guide [H, W], codes in [0, 1] of at least as many pixels.

    Args:
        small: the picture.
        guide: the photo.
        reduce: returns averages [h, w] of [H, W].
        enlarge: interpolates [h, w] at [H, W].
        trusted: median deviations from which what the model gets wrong is more than noise, and is added.
    """
    reduced = reduce(guide)
    mean, mean_reduced = _blur(small), _blur(reduced)
    variance = np.maximum(_blur(reduced * reduced) - mean_reduced**2, 0) + np.float32(_NOISE)
    slope = (_blur(reduced * small) - mean_reduced * mean) / variance
    result = enlarge(slope) * guide + enlarge(small - slope * reduced)
    difference = small - reduce(result)
    deviation = np.median(np.abs(difference)) / np.float32(0.6745) * np.float32(trusted)
    difference *= np.maximum(0, 1 - (deviation / np.maximum(np.abs(difference), np.float32(1e-9))) ** 2)
    return result + enlarge(difference)


def _blur(values: np.ndarray) -> np.ndarray:
    from scipy.ndimage import gaussian_filter  # Takes a second to load

    return gaussian_filter(values, _RADIUS, mode="nearest", truncate=3)
