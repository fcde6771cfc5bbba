"""A tone map for pictures of scene-linear radiance.

It is Reinhard's extended global operator (Reinhard et al. 2002, Eq. 4) on luminance, with the key and the
white point found from the scene (Reinhard 2003). Scaling by luminance alone would leave bright colors outside the
display's gamut, and mapping each channel alone would bleach them; the two are mixed by the display luminance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .display import MIDDLE_GREY, encode_srgb

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # ITU-R BT.709 luminance weights
_FLOOR = 1e-6  # Below this part of the brightest per cent, a pixel says nothing about the scene's key
# Reinhard 2003 uses the extremes; percentiles keep a lamp's filament from deciding the picture.
_LOW, _HIGH, _WHITE = 1.0, 99.0, 99.8
# Most that pictures are brighter than photos: sound captures have half to 1.6 times, those with much black up to 2^8.
_BRIGHTEST = 2.0


@dataclass(frozen=True)
class ToneMap:
    """Reinhard's operator with fixed parameters."""

    scale: float  # Factor on radiance that brings the scene's log-average to its key
    white: float  # Least scaled luminance that is shown as white

    def __call__(self, radiance: np.ndarray) -> np.ndarray:
        """Convert [..., 3] linear Rec.709 radiance to sRGB-encoded float32 in [0, 1]; negative radiance counts as 0."""
        scaled = np.maximum(np.asarray(radiance, np.float32), 0) * np.float32(self.scale)
        luminance = (scaled @ LUMINANCE.astype(np.float32))[..., None]
        displayed = self._curve(luminance)
        by_luminance = scaled * (displayed / np.maximum(luminance, 1e-12))
        weight = np.minimum(displayed, 1)
        return encode_srgb(by_luminance * (1 - weight) + self._curve(scaled) * weight)

    def _curve(self, value: np.ndarray) -> np.ndarray:
        return value * (1 + value / np.float32(self.white**2)) / (1 + value)


def fit_tone_map(
    pictures: Sequence[np.ndarray], alphas: Sequence[np.ndarray | None] = (), gain: float = np.inf
) -> ToneMap:
    """Return one tone map for pictures of a scene.

    A dark ground around a bright subject would brighten the subject to white. So pictures get at most one stop
    brighter than photos, or than photos whose brightest per cent is white. Black scenes get the identity.

    Args:
        pictures: [H, W, 3] linear Rec.709 radiance each.
        alphas: [H, W] coverage of each, or None. Where at least half of a pixel is empty, as around an object that was
            cut out, it says nothing about the scene's key.
        gain: factor from radiance to display light at the exposure of the photos; without it nothing limits the scale.

    Raises:
        ValueError: without pictures.
    """
    parts = []
    for picture, alpha in zip(pictures, alphas or [None] * len(pictures), strict=True):
        # float64 before the logarithm: radiance may be small in its units.
        luminance = np.maximum(np.asarray(picture, np.float64), 0) @ LUMINANCE
        covered = None if alpha is None else np.asarray(alpha) > 0.5
        parts.append(luminance.ravel() if covered is None or not covered.any() else luminance[covered])
    values = np.concatenate(parts)
    values = values[np.isfinite(values) & (values > 0)]  # Writers refuse what is not finite, and say where.
    if not values.size:
        return ToneMap(1.0, 1.0)
    values = values[values > (bright := np.percentile(values, _HIGH)) * _FLOOR]
    logs = np.log2(values)
    (low, high), average = np.percentile(logs, (_LOW, _HIGH)), logs.mean()
    # Between 0.09 for a mostly dark scene with highlights and 0.36 for a bright one.
    key = MIDDLE_GREY * 2.0 ** np.clip((2 * average - low - high) / max(high - low, 1e-6), -1, 1)
    scale = min(key / 2.0**average, _BRIGHTEST * max(gain, 1 / bright))
    # A white below 1 would make the curve convex, and brighten everything.
    return ToneMap(float(scale), float(max(np.percentile(values, _WHITE) * scale, 1.0)))
