"""The catalogue's light: exposures, responses, logarithms, fusion, losses and similarity."""

import math
from types import SimpleNamespace

import numpy as np
import torch

from ..field.fusion import NeuralExposureFusion
from ..response import Response, response_by_name
from ..response.table import TabulatedResponse
from ..splatting import ssim
from ..training.config import LossConfig
from ..training.losses import CODE, Target, code_scale, ldr_loss
from .case import ROUNDINGS, UNIT, Case, Reading, compare, count, not_finite

LIGHT = "light"
CURVES = ("linear", "gamma-2.2", "srgb", "rec709", "reinhard-gamma", "filmic", "aces")


def _response_readings(curve: Response, device, exposures, label: str) -> list[Reading]:
    """Photo, its derivative, and the exposure that the photo decodes to, of one curve."""

    def encode(exposure):
        return {"f": curve.encode(exposure)}

    # A filmic curve's derivative is the difference of terms that are up to 50 times as large (x near its white).
    extra = 64 * UNIT if curve.name in ("filmic", "aces") else 0.0
    readings = compare(
        encode, lambda _, x: encode(x), {"x": exposures}, device, gradients=("x",), elementwise=True, floor=1e-6,
        extra=extra,
    )  # fmt: skip
    values = torch.linspace(curve.black + 2 * CODE, curve.peak - 2 * CODE, 97, dtype=torch.float64)
    readings += compare(
        lambda v: {"decode": curve.decode(v)}, lambda _, v: {"decode": curve.decode(v)}, {"v": values}, device,
        elementwise=True, floor=1e-6,
    )  # fmt: skip
    return [Reading(f"{label} {r.quantity}", r.error, r.bound) for r in readings]


def _exposures(device):
    """Radiance 1 photographed for 2^-24 to 2^24 seconds, half-way between whole stops, by every curve."""
    times = 2.0 ** torch.arange(-24.0, 24.0, 0.37, dtype=torch.float64)
    readings = []
    for name in CURVES:
        readings += _response_readings(response_by_name(name), device, times, name)
    return readings


def _odd_responses(device):
    """Curves that a file may hold: flat, steep, not monotone by noise, and clipped at both ends."""
    x = np.linspace(0, 1, 300)
    noise = np.random.default_rng(0).normal(0, 0.02, 300)
    curves = {
        "flat": np.where(x < 0.3, x, np.where(x < 0.7, 0.3, x - 0.4 + 0.3)) / 0.9,
        "steep": 0.5 + 0.5 * np.tanh((x - 0.5) * 1000),
        "noisy": np.clip(x**0.5 + noise, 0, 1),
        "clipped": np.clip((x - 0.2) * 2, 0, 1),
    }
    at = torch.linspace(0.0013, 1.3, 211, dtype=torch.float64)
    readings = []
    for name, values in curves.items():
        curve = TabulatedResponse(name, x, np.clip(values, 0, 1))
        readings += [r for r in _response_readings(curve, device, at, name) if not r.quantity.endswith("d/d x")]
        again = curve.decode(curve.encode(at.clamp_max(curve.clip_exposure).to(device, torch.float32)))
        readings.append(count(f"{name}: not finite after encode and decode", not_finite(again)))
    return readings


def _extremes(device):
    """Zero, denormal, huge and infinite exposures: a value within [0, 1] and a finite derivative everywhere."""
    wrong = 0
    for name in CURVES:
        curve = response_by_name(name)
        x = torch.tensor([0.0, 1e-45, 1e-38, 1e-20, 1e20, 3e38, math.inf], device=device, requires_grad=True)
        for encode in (curve.encode, curve.encode_extended):
            value = encode(x)
            (slope,) = torch.autograd.grad(value[:-1].sum(), x)
            wrong += not_finite(value[:-1], slope) + int((value < 0).sum())
        wrong += int(((curve.encode(x) > 1) | curve.encode(x).isnan()).sum())
    return [count("values or derivatives out of range", wrong)]


def _zero_radiance(device):
    """The logarithm of zero radiance: a black photo as a start, and fusion of log 0 = -infinity."""
    from ..field.radiance_field import EXPOSURE_FLOOR

    fusion = _fusion(0.2).to(device)
    logs = torch.tensor([[-math.inf] * 3, [-200.0] * 3, [math.log(EXPOSURE_FLOOR)] * 3])
    wrong = 0
    for evaluate in (fusion.exact, fusion.tabulated):
        wrong += not_finite(evaluate(logs.to(device)))
    decoded = torch.cat([response_by_name(name).decode(torch.zeros(1, device=device)) for name in CURVES])
    floored = decoded.clamp_min(EXPOSURE_FLOOR).log()
    return [count("not finite in fusion", wrong), count("not finite in the start's logarithm", not_finite(floored))]


class _Exact(NeuralExposureFusion):
    """The fusion by its equations, without the table."""

    forward = NeuralExposureFusion.exact


def _fusion(sigma: float) -> NeuralExposureFusion:
    return _Exact(response_by_name("srgb"), (1 / 8, 1 / 4, 1.0, 8.0, 16.0), 1.0, width=16, sigma=sigma)


def _fused(fusion: NeuralExposureFusion):
    """The equations as a function of base, sigma and the last layer, in whichever precision these come."""

    def function(log_base, log_sigma, last):
        parameters = {name: value.to(log_base) for name, value in fusion.named_parameters()}
        parameters |= {"log_sigma": log_sigma, "weights.1": last}
        return {"fused": torch.func.functional_call(fusion, parameters, (log_base,))}

    return function


def _fusion_case(sigma: float, gain: float) -> callable:
    """sigma: start of the widths. gain: of the last layer: logits reach a tenth of it."""

    def measure(device):
        fusion = _fusion(sigma)
        generator = torch.Generator().manual_seed(0)
        log_base = torch.empty(400, 3, dtype=torch.float64).uniform_(-9, 4, generator=generator)
        tensors = {
            "log_base": log_base,
            "log_sigma": fusion.log_sigma.detach().double(),
            "last": fusion.weights[1].detach().double() * gain,
        }
        function = _fused(fusion)
        # Each logit is rounded by itself, at its own size; what differs by that much, the softmax sees as a factor.
        extra = ROUNDINGS * UNIT * gain / 10
        readings = compare(function, lambda _, *t: function(*t), tensors, device, gradients=("last",), extra=extra)
        given = {name: t.to(device, torch.float32).requires_grad_() for name, t in tensors.items()}
        function(*given.values())["fused"].sum().backward()
        return [*readings, count("derivatives not finite", not_finite(*(t.grad for t in given.values())))]

    return measure


def _sigma_limits(device):
    """log sigma of +-1e3: widths that float32 cannot hold are held at its limits, derivatives stay finite."""
    wrong = 0
    for log_sigma in (-1e3, -80.0, 80.0, 1e3):
        fusion = _fusion(1.0).to(device)
        with torch.no_grad():
            fusion.log_sigma.fill_(log_sigma)
        log_base = torch.linspace(-9, 4, 300, device=device).reshape(100, 3).requires_grad_()
        value = fusion(log_base)
        value.sum().backward()
        wrong += not_finite(value, log_base.grad, *(p.grad for p in fusion.parameters() if p.grad is not None))
        wrong += int((value < -1e-6).sum())
    return [count("not finite or negative", wrong)]


def _photos(device):
    """Photos that are all clipped, all black, or black but for one pixel: the loss and its derivative."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(24, 20, 3, generator=generator, dtype=torch.float64)
    spot = torch.zeros(24, 20, 3, dtype=torch.float64)
    spot[11, 7] = 1.0
    readings = []
    for name, photo in (("clipped", torch.ones_like(noise)), ("black", torch.zeros_like(noise)), ("one pixel", spot)):

        def loss(prediction, photo=photo):
            return {"loss": _loss(prediction, photo)}

        prediction = 0.05 + 0.9 * noise
        readings += [
            Reading(f"{name} {r.quantity}", r.error, r.bound)
            for r in compare(
                loss, lambda _, p, loss=loss: loss(p), {"prediction": prediction}, device, gradients=("prediction",)
            )
        ]
    met = [("above white", 1.0, 3.0), ("below black", 0.0, -1.0)]
    for name, photo, value in met:
        prediction = torch.full((8, 8, 3), value, device=device, requires_grad=True)
        photo = torch.full((8, 8, 3), photo, device=device)
        _loss(prediction, photo).backward()
        readings.append(count(f"{name}: pixels that still pull", (prediction.grad != 0).sum()))
    return readings


def _loss(prediction, photo):
    """The training's loss between encoded values of a simulated photo [H, W, 3] and a photo of black and white."""
    codes = (255 * photo).to(prediction.device, torch.uint8)
    target = Target(codes, code_scale(255, None, prediction.device, dtype=prediction.dtype))
    return ldr_loss(SimpleNamespace(encoded=prediction), target, LossConfig())


def _similarity(device):
    """SSIM of constant, equal, opposite and tiny images, of 1 x 1 and of odd size."""
    generator = torch.Generator().manual_seed(0)
    readings = []
    for name, shape, change in (
        ("1 x 1", (1, 1, 3), lambda a: 1 - a),
        ("odd", (13, 7, 3), lambda a: 1 - a),
        ("white", (9, 30, 3), lambda a: torch.ones_like(a)),
        ("near-equal", (16, 16, 3), lambda a: a + 1e-4),
        ("tiny", (16, 16, 3), lambda a: a * 1e-20),
    ):
        a = torch.rand(shape, generator=generator, dtype=torch.float64)
        b = change(a)
        if name == "white":
            a = b - 1e-3 * a
        readings += [
            Reading(f"{name} {r.quantity}", r.error, r.bound)
            for r in compare(
                lambda a, b: {"ssim": ssim(a, b)}, lambda _, a, b: {"ssim": ssim(a, b)}, {"a": a, "b": b}, device,
                gradients=("a",), extra=_variance_error(),
            )
        ]  # fmt: skip
    return readings


def _variance_error() -> float:
    """E[x^2] - E[x]^2 of values up to 1 has an error of some units, next to the constant C2 = 9e-4 of the quotient."""
    return 8 * UNIT / 9e-4


CASES = (
    Case("exposures", LIGHT, "exposures from 2^-24 to 2^24 s through every response", _exposures),
    Case("responses", LIGHT, "flat, steep, noisy and clipped curves", _odd_responses),
    Case("exposure-limits", LIGHT, "zero, denormal, huge and infinite exposures", _extremes),
    Case("log-zero", LIGHT, "the logarithm of zero radiance", _zero_radiance),
    Case("sigma-small", LIGHT, "fusion with sigma 1e-3", _fusion_case(1e-3, 1.0)),
    Case("sigma-large", LIGHT, "fusion with sigma 1e3", _fusion_case(1e3, 1.0)),
    Case("sigma-limits", LIGHT, "fusion with sigma towards 0 and infinity", _sigma_limits),
    Case(
        "logits",
        LIGHT,
        "softmax logits of +-1e4",
        _fusion_case(1e3, 1e5),
        note="a logit of 1e4 is known to 1e-3 in float32, and the weights of the brackets to no better",
    ),
    Case("photos", LIGHT, "photos all clipped, all black, and with one bright pixel", _photos),
    Case("similarity", LIGHT, "SSIM of flat, equal, opposite and tiny images", _similarity),
)
