"""The exposure at which a display shows light as the photos do."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import SehdrError, require_number
from ...scene.color.primaries import linear_to_srgb

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

MIDDLE_GREY = 0.18


def expose(radiance: np.ndarray, stops: float, *, scale: float = 1.0) -> np.ndarray:
    """Return [..., 3] radiance as a display shows it: radiance scale 2^stops, clipped to [0, 1], sRGB-encoded.

    `scale` brings the picture to its normal exposure: the base exposure time, or ToneMap.scale.
    """
    return encode_srgb(np.asarray(radiance, np.float32) * np.float32(scale * 2.0**stops))


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode display-linear values, limited to [0, 1], by IEC 61966-2-1; float32."""
    return linear_to_srgb(np.clip(np.asarray(linear, np.float32), 0, 1))


def display_gain(response: Any) -> float:
    """Return the factor from exposures of a response to display light that shows a photo's middle grey as middle grey.

    It is 1 for sRGB's curve, which RAW and linear photos get, and green's if a learned response differs by channel.
    """
    grey = float(response.decode(encode_srgb(np.full((1, 3), MIDDLE_GREY)).astype(np.float64))[0, 1])
    return MIDDLE_GREY / grey if grey > 0 else 1.0


def exposure_for_white(run: "RenderableScene", white: float | None) -> float:
    """Return the seconds to multiply radiance by so that a file holds display white as `white`; 1 for None.

    Display white is 1 / MIDDLE_GREY times the light that photos show as middle grey (see display_gain): for a camera
    whose curve is sRGB, the photos' white; for a logarithm less than that.

    Raises:
        SehdrError: For a white outside 0.001 to 10000.
    """
    if white is not None:
        require_number(white, "reference_white")
    exposure = 1.0 if white is None else white * run.base_time * display_gain(run.response)
    if not (math.isfinite(exposure) and exposure > 0 and (white is None or 1e-3 <= white <= 1e4)):
        raise SehdrError(f"reference white {white} is not between 0.001 and 10000; 1 shows the photos' white as 1")
    return exposure
