"""Veiling glare: the light that a lens scatters over the whole picture."""

import math

import numpy as np

from ..errors import InputError

MOST_GLARE = 20.0  # Percent; at more than about 30 a large picture's pixels would keep no light of their own
PATCH = 0.1  # Diameter of the black patch on which the index is measured, as a share of the picture's diagonal


def add_glare(radiance: np.ndarray, index: float) -> np.ndarray:
    """Scatter a part of each pixel's light over a picture, by the inverse square of the distance.

    The tail of measured glare spread functions reaches over the whole picture (Talvala et al. 2007, "Veiling Glare in
    High Dynamic Range Imaging"; McCann and Rizzi 2007). The inverse square, the law of scattering by dust and polish,
    stands for them: each doubling of the distance receives as much light. Ghosts and colors of a lens are left out.

    What lies outside of a picture is unknown. Here it is the picture's mirror image, so that as much light enters as
    leaves: the sum over all pixels stays.

    Args:
        radiance: [H, W, C] scene-linear, at least 0.
        index: veiling glare index (ISO 9358), percent: the light at the center of a black patch of a tenth of the
            diagonal, relative to the uniform surround. Lenses have 0.5 to 3. 0 returns the picture itself.

    Returns:
        [H, W, C] float64; `radiance` itself for an index of 0.

    Raises:
        InputError: for an index outside of 0 to MOST_GLARE, or radiance that is not finite.
    """
    if not 0 <= index <= MOST_GLARE:
        raise InputError("veiling glare", f"index of {index:g} %", f"give 0 to {MOST_GLARE:g}")
    if index == 0:
        return radiance
    if not np.isfinite(radiance).all():
        raise InputError("veiling glare", "radiance that is not finite would spread to all pixels", "correct the truth")
    from scipy.fft import dctn, idctn

    height, width = radiance.shape[:2]
    spread = _transfer(height, width, index / 100)
    light: np.ndarray = dctn(radiance.astype(np.float64), axes=(0, 1))  # pyright: ignore[reportAssignmentType]
    light *= spread[..., None]
    scattered: np.ndarray = idctn(light, axes=(0, 1))  # pyright: ignore[reportAssignmentType]
    return np.maximum(scattered, 0)  # Rounding leaves black pixels below 0.


def _transfer(height: int, width: int, index: float) -> np.ndarray:
    """Return the factors [H, W] of a picture's cosine transform: a mirrored picture repeats after twice its size."""
    from scipy.fft import dctn

    rows, columns = np.arange(height + 1.0)[:, None], np.arange(width + 1.0)
    square = rows**2 + columns**2
    square[0, 0] = np.inf  # What a pixel scatters onto itself is not seen.
    kernel = 1 / square
    # Each distance occurs on both sides, except for none and for half of the period.
    sides = np.where((rows % height == 0), 1, 2) * np.where((columns % width == 0), 1, 2)
    beyond = square > (PATCH / 2 * math.hypot(height, width)) ** 2
    kernel *= index / (kernel * sides)[beyond].sum()
    spread: np.ndarray = dctn(kernel, type=1)  # pyright: ignore[reportAssignmentType]
    return 1 - spread[0, 0] + spread[:height, :width]
