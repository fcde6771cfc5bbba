"""Responses with a formula: power laws with a linear toe, and tone curves followed by one."""

import math
from typing import NamedTuple

import numpy as np
import torch

from ..errors import SehdrError, did_you_mean
from ..rasterizer.ops.response_curves import FormulaCurve, encode_with_slope
from .curve import HALF_CODE, Response
from .names import DESCRIPTIONS


class PowerLaw(NamedTuple):
    """y = toe_slope x below toe_end, (1 + offset) x^(1/exponent) - offset above; 1 at x = 1.

    Covers linear (toe_end 1), a gamma, sRGB (IEC 61966-2-1) and Rec.709 (ITU-R BT.709, BT.2020's exact constants).
    """

    exponent: float
    offset: float
    toe_slope: float
    toe_end: float

    def invert(self, value):
        """Return the exposure of a value."""
        power = ((value + self.offset) / (1.0 + self.offset)).pow(self.exponent)
        return torch.where(value < self.toe_slope * self.toe_end, value / self.toe_slope, power)


class Reinhard:
    """y = x / (1 + x), which approaches 1 and never reaches it (Reinhard et al. 2002)."""

    kind, numbers, clip_exposure = "reinhard", (), math.inf

    def invert(self, value):
        """Return the exposure of a value below 1."""
        return value / (1.0 - value)


class Filmic:
    """y = (a x^2 + b x) / (d x^2 + e x + g) / peak, with the constants so chosen that y(clip_exposure) = 1."""

    kind = "filmic"

    def __init__(self, a, b, d, e, g, clip_exposure):
        """Normalize the constants of the formula so that clip_exposure is white."""
        x = self.clip_exposure = clip_exposure
        peak = (a * x * x + b * x) / (d * x * x + e * x + g)
        self.numbers = (a / peak, b / peak, d, e, g)

    def invert(self, value):
        """Return the exposure of a value."""
        # P x^2 + Q x = g y, by whichever form of the positive root does not cancel.
        a, b, d, e, g = self.numbers
        square, linear, constant = a - value * d, b - value * e, value * g
        root = (linear.square() + 4.0 * square * constant).sqrt()
        return torch.where(linear > 0, 2.0 * constant / (root + linear), (root - linear) / (2.0 * square))


class Knee:
    """y = x up to `start`, then start + softness ln(1 + (x - start) / softness): a camera's roll-off into white.

    The slope falls steadily from 1; y = 1 at clip_exposure = start + softness (exp((1 - start) / softness) - 1).
    """

    kind = "knee"

    def __init__(self, start: float, softness: float):
        """Compute the clip point of a knee that begins at `start` and bends by `softness`."""
        self.numbers = (start, softness)
        self.clip_exposure = start + softness * math.expm1((1.0 - start) / softness)

    def invert(self, value):
        """Return the exposure of a value."""
        start, softness = self.numbers
        return value.clamp_max(start) + softness * ((value - start).clamp_min(0.0) / softness).expm1()


class AnalyticResponse(Response, kind="analytic"):
    """A curve that its name describes in full: f(x) = display(tone(x)), or display(x) with white at x = 1."""

    black, peak = 0.0, 1.0

    def __init__(self, name: str, display: PowerLaw, tone: Reinhard | Filmic | Knee | None = None):
        """Combine a tone curve, if there is one, with the display curve that follows it."""
        self.name = name
        self._display, self._tone = display, tone
        self.curve = FormulaCurve(display)
        if tone is not None:
            self.curve = FormulaCurve(display, tone.kind, tone.numbers, tone.clip_exposure)
        self.clip_exposure = self.curve.clip

    def _encode(self, exposure, extension_slope):
        return encode_with_slope(exposure, self.curve, extension_slope)

    def _invert(self, value):
        light = self._display.invert(value)
        return light if self._tone is None else self._tone.invert(light)

    def rise(self, value):
        """Return d ln x / dz at values z; see Response.rise."""
        # By the inverse, because the slope would compile a kernel for each curve.
        values = torch.from_numpy(np.minimum(value, self._limit)).requires_grad_()
        with torch.enable_grad():
            self._invert(values).log().sum().backward()
        assert values.grad is not None
        return values.grad.numpy()

    def to_dict(self):
        """Return plain values for JSON."""
        return {"kind": "analytic", "name": self.name}

    @classmethod
    def _from_dict(cls, values):
        return analytic_response(values["name"])


def _gamma(exponent: float) -> PowerLaw:
    """Return a power law with a finite slope: its toe is the chord from 0 to half an 8-bit code."""
    toe_end = HALF_CODE**exponent
    return PowerLaw(exponent, 0.0, HALF_CODE / toe_end, toe_end)


_SRGB = PowerLaw(2.4, 0.055, 12.92, 0.0031308)
_REC709 = PowerLaw(1.0 / 0.45, 0.09929682680944, 4.5, 0.018053968510807)
# Hable's Uncharted 2 curve (GDC 2010), (x(Ax+CB)+DE)/(x(Ax+B)+DF) - E/F with A to F = 0.15, 0.5, 0.1, 0.2, 0.02, 0.3,
# over one denominator; white at 11.2.
_HABLE = Filmic(0.15 * (1 - 0.02 / 0.3), 0.5 * (0.1 - 0.02 / 0.3), 0.15, 0.5, 0.2 * 0.3, 11.2)
# Narkowicz's fit to the ACES reference transform (2015); it reaches 1 where its two quadratics meet.
_ACES = Filmic(2.51, 0.03, 2.43, 0.59, 0.14, (0.56 + math.sqrt(0.56**2 + 4 * 0.08 * 0.14)) / (2 * 0.08))
# The knee's two numbers are the best on a grid for the worse of two measured cameras (Canon EOS 5D Mark II, Sony A6000:
# docs/response.md).
_CURVES = {
    "camera": (_REC709, Knee(0.55, 0.25)),
    "srgb": (_SRGB, None),
    "gain-map": (_SRGB, None),
    "rec709": (_REC709, None),
    "gamma-2.2": (_gamma(2.2), None),
    "linear": (PowerLaw(1.0, 0.0, 1.0, 1.0), None),
    "hdr-nerf": (_gamma(2.2), Reinhard()),
    "filmic": (_SRGB, _HABLE),
    "aces": (_SRGB, _ACES),
}
_ALIASES = {"reinhard-gamma": "hdr-nerf", "gamma": "gamma-2.2", "rec.709": "rec709", "bt709": "rec709"}


def analytic_response(name: str) -> Response:
    """Return the response of a formula's name: one of DESCRIPTIONS, an alias, or `gamma-G` with G in [1, 5].

    Raises:
        SehdrError: for any other name.
    """
    key = _ALIASES.get(name.lower(), name.lower())
    if key in _CURVES:
        display, tone = _CURVES[key]
        return AnalyticResponse(key, display, tone)
    if key.startswith("gamma-"):
        try:
            exponent = float(key.removeprefix("gamma-"))
        except ValueError:
            exponent = math.nan
        if not 1.0 <= exponent <= 5.0:
            raise SehdrError(f"response {name!r}: the exponent of gamma-G must be a number from 1 to 5")
        return AnalyticResponse(key, _gamma(exponent))
    if name in ("auto", "learned"):  # Other spellings are unknown to trainings, too.
        raise SehdrError(f"response {name!r} comes from a training's photos; name a curve or a file here")
    hint = did_you_mean(name, DESCRIPTIONS)
    names_text = ", ".join((*DESCRIPTIONS, "gamma-G", "colour:NAME"))
    raise SehdrError(f"response {name!r} is neither a file nor a known name{hint}; take one of {names_text}, or a file")
