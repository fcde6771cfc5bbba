"""Responses with a formula: power laws with a linear toe, and tone curves followed by one."""

import math

import torch

from ..errors import SehdrError, did_you_mean
from ..splatting.response_curves import FormulaCurve
from .curve import HALF_CODE, Response


class AnalyticResponse(Response, kind="analytic"):
    """A curve that its name describes in full."""

    black, peak = 0.0, 1.0

    def to_dict(self):
        return {"kind": "analytic", "name": self.name}

    @classmethod
    def _from_dict(cls, values):
        return analytic_response(values["name"])


class PowerLaw(AnalyticResponse):
    """f(x) = toe_slope x below toe_end, (1 + offset) x^(1/exponent) - offset above, white at x = 1.

    Covers linear (toe_end 1), a pure gamma, sRGB (IEC 61966-2-1) and Rec.709 (ITU-R BT.709, with BT.2020's exact
    constants). A pure gamma has an infinite slope at 0; its toe is the chord from the origin to half an 8-bit code,
    so every stored code but 0 is exact and the slope stays finite.
    """

    clip_exposure = 1.0

    def __init__(self, name: str, exponent: float, offset: float, toe_slope: float, toe_end: float):
        self.name = name
        self._exponent, self._offset, self._toe_slope, self._toe_end = exponent, offset, toe_slope, toe_end

    def formula(self):
        return FormulaCurve((self._exponent, self._offset, self._toe_slope, self._toe_end))

    def _evaluate(self, exposure, with_slope):
        line_slope = torch.full_like(exposure, self._toe_slope) if with_slope else None
        if self._toe_end >= 1.0:
            return self._toe_slope * exposure, line_slope
        power = exposure.pow(1.0 / self._exponent) * (1.0 + self._offset)
        toe = exposure < self._toe_end
        value = torch.where(toe, self._toe_slope * exposure, power - self._offset).clamp_max(1.0)
        if not with_slope:
            return value, None
        return value, torch.where(toe, self._toe_slope, power / (self._exponent * exposure))

    def _invert(self, value):
        if self._toe_end >= 1.0:
            return value / self._toe_slope
        power = ((value + self._offset) / (1.0 + self._offset)).pow(self._exponent)
        return torch.where(value < self._toe_slope * self._toe_end, value / self._toe_slope, power)


class Reinhard:
    """y = x / (1 + x), which approaches 1 and never reaches it (Reinhard et al. 2002)."""

    clip_exposure = math.inf
    kind, numbers = "reinhard", ()

    def evaluate(self, exposure, with_slope):
        # As 1 / (1 + 1/x): exact at both ends in float32, also for x = 0 and infinity.
        value = 1.0 / (1.0 + 1.0 / exposure)
        return value, (1.0 + exposure).square().reciprocal() if with_slope else None

    def invert(self, value):
        return value / (1.0 - value)


class Filmic:
    """y = (a x^2 + b x) / (d x^2 + e x + g) / peak, with the constants so chosen that y(clip_exposure) = 1."""

    def __init__(self, a, b, d, e, g, clip_exposure):
        self.clip_exposure = clip_exposure
        x = clip_exposure
        peak = (a * x * x + b * x) / (d * x * x + e * x + g)
        self._a, self._b, self._d, self._e, self._g = a / peak, b / peak, d, e, g
        self.kind, self.numbers = "filmic", (self._a, self._b, d, e, g)

    def evaluate(self, exposure, with_slope):
        above = exposure * (self._a * exposure + self._b)
        below = exposure * (self._d * exposure + self._e) + self._g
        value = above / below
        if not with_slope:
            return value, None
        rise = 2.0 * self._a * exposure + self._b - value * (2.0 * self._d * exposure + self._e)
        return value, rise / below

    def invert(self, value):
        # P x^2 + Q x = g y, by whichever form of the positive root does not cancel.
        square, linear, constant = self._a - value * self._d, self._b - value * self._e, value * self._g
        root = (linear.square() + 4.0 * square * constant).sqrt()
        return torch.where(linear > 0, 2.0 * constant / (root + linear), (root - linear) / (2.0 * square))


class Knee:
    """y = x up to `start`, then start + softness ln(1 + (x - start) / softness): a camera's roll-off into white.

    The slope falls steadily from 1; y = 1 at clip_exposure = start + softness (exp((1 - start) / softness) - 1).
    """

    def __init__(self, start: float, softness: float):
        self._start, self._softness = start, softness
        self.kind, self.numbers = "knee", (start, softness)
        self.clip_exposure = start + softness * math.expm1((1.0 - start) / softness)

    def evaluate(self, exposure, with_slope):
        beyond = (exposure - self._start).clamp_min(0.0) / self._softness
        value = exposure.clamp_max(self._start) + self._softness * beyond.log1p()
        return value, (1.0 + beyond).reciprocal() if with_slope else None

    def invert(self, value):
        beyond = (value - self._start).clamp_min(0.0) / self._softness
        return value.clamp_max(self._start) + self._softness * beyond.expm1()


class ToneMapped(AnalyticResponse):
    """A tone curve on exposure, then a display encoding: f(x) = display(tone(x))."""

    def __init__(self, name: str, tone: Reinhard | Filmic | Knee, display: PowerLaw):
        self.name = name
        self.clip_exposure = tone.clip_exposure
        self._tone, self._display = tone, display

    def formula(self):
        law = self._display.formula().power_law
        return FormulaCurve(law, self._tone.kind, self._tone.numbers, self.clip_exposure)

    def _evaluate(self, exposure, with_slope):
        light, tone_slope = self._tone.evaluate(exposure, with_slope)
        value, slope = self._display._evaluate(light.clamp(0.0, 1.0), with_slope)
        return value, None if slope is None or tone_slope is None else slope * tone_slope

    def _invert(self, value):
        return self._tone.invert(self._display._invert(value))


def _gamma(name: str, exponent: float) -> PowerLaw:
    toe_end = HALF_CODE**exponent
    return PowerLaw(name, exponent, 0.0, HALF_CODE / toe_end, toe_end)


def _srgb() -> PowerLaw:
    return PowerLaw("srgb", 2.4, 0.055, 12.92, 0.0031308)


def _rec709() -> PowerLaw:
    return PowerLaw("rec709", 1.0 / 0.45, 0.09929682680944, 4.5, 0.018053968510807)


def _hable() -> ToneMapped:
    """Hable's Uncharted 2 curve (GDC 2010), (x(Ax+CB)+DE)/(x(Ax+B)+DF) - E/F over one denominator; white at 11.2."""
    a, b, c, d, e, f = 0.15, 0.50, 0.10, 0.20, 0.02, 0.30
    return ToneMapped("filmic", Filmic(a * (1 - e / f), b * (c - e / f), a, b, d * f, 11.2), _srgb())


def _aces() -> ToneMapped:
    """Narkowicz's fit to the ACES reference transform (2015); it reaches 1 where its two quadratics meet."""
    clip = (0.56 + math.sqrt(0.56**2 + 4 * 0.08 * 0.14)) / (2 * 0.08)
    return ToneMapped("aces", Filmic(2.51, 0.03, 2.43, 0.59, 0.14, clip), _srgb())


def _camera() -> ToneMapped:
    """A camera's own JPEG: Rec.709 with its linear toe, and a knee into white. The knee's two numbers are the best on a
    grid for the worse of two measured cameras (Canon EOS 5D Mark II, Sony A6000: docs/response.md)."""
    return ToneMapped("camera", Knee(0.55, 0.25), _rec709())


_BANK = {
    "linear": lambda: PowerLaw("linear", 1.0, 0.0, 1.0, 1.0),
    "gamma-2.2": lambda: _gamma("gamma-2.2", 2.2),
    "srgb": _srgb,
    "rec709": _rec709,
    "hdr-nerf": lambda: ToneMapped("hdr-nerf", Reinhard(), _gamma("gamma-2.2", 2.2)),
    "filmic": _hable,
    "aces": _aces,
    "camera": _camera,
}
DESCRIPTIONS = {
    "camera": "a camera's own JPEG: Rec.709 with a roll-off into white",
    "srgb": "sRGB (IEC 61966-2-1): renders, and photos developed without a tone curve",
    "rec709": "Rec.709 video (ITU-R BT.709)",
    "gamma-2.2": "a power law; gamma-G with any G from 1 to 5",
    "linear": "values proportional to light",
    "hdr-nerf": "Reinhard's curve and gamma 2.2, of HDR-NeRF's synthetic sets; also called reinhard-gamma",
    "filmic": "Hable's filmic curve (Uncharted 2), shown as sRGB",
    "aces": "Narkowicz's fit to the ACES display transform, shown as sRGB",
}
"""What each name stands for."""
_ALIASES = {"reinhard-gamma": "hdr-nerf", "gamma": "gamma-2.2", "rec.709": "rec709", "bt709": "rec709"}


def analytic_names() -> tuple[str, ...]:
    """The names of the responses that have a formula, without aliases and without other exponents of `gamma-`."""
    return tuple(_BANK)


def analytic_response(name: str) -> Response:
    """A response by its formula's name: one of analytic_names(), an alias, or `gamma-G` with G in [1, 5].

    Raises SehdrError for any other name.
    """
    key = _ALIASES.get(name.lower(), name.lower())
    if key in _BANK:
        return _BANK[key]()
    if key.startswith("gamma-"):
        try:
            exponent = float(key.removeprefix("gamma-"))
        except ValueError:
            exponent = math.nan
        if not 1.0 <= exponent <= 5.0:
            raise SehdrError(f"response {name!r}: the exponent of gamma-G must be a number from 1 to 5")
        return _gamma(key, exponent)
    hint = did_you_mean(name, DESCRIPTIONS)
    known = ", ".join((*DESCRIPTIONS, "gamma-G", "colour:NAME"))
    raise SehdrError(f"response {name!r} is neither a file nor a known name{hint}; take one of {known}, or a file")
