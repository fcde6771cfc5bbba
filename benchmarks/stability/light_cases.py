"""The catalogue's light: exposures, responses, logarithms, fusion, losses and similarity."""

import math
from functools import partial

import numpy as np
import torch

from sehdr_warp.check.case import ROUNDINGS, UNIT, Case, Reading, compare, count, not_finite
from sehdr_warp.model.color_models import EXPOSURE_FLOOR
from sehdr_warp.model.fusion import NeuralExposureFusion
from sehdr_warp.model.renders import PhotoRender
from sehdr_warp.rasterizer import ssim
from sehdr_warp.rasterizer.losses.photo_loss import ClippedWeights, clipped_light_energy
from sehdr_warp.rasterizer.ops.exposure_fusion import fusion_weights
from sehdr_warp.response import Response, response_by_name
from sehdr_warp.response.table import TabulatedResponse
from sehdr_warp.runs.config import LossConfig
from sehdr_warp.training.losses import ldr_loss
from sehdr_warp.training.targets import CODE, Target, code_scale

CURVES = ("linear", "gamma-2.2", "srgb", "rec709", "reinhard-gamma", "filmic", "aces")
BRACKETS = (1 / 8, 1 / 4, 1.0, 8.0, 16.0)
VARIANCE_ERROR = 8 * UNIT / 9e-4
"""E[x^2] - E[x]^2 of values up to 1 has an error of some units, next to the constant C2 = 9e-4 of SSIM's quotient."""


def _response_readings(curve: Response, device, exposures, **options) -> list[Reading]:
    """Photo, its derivative where asked for, and the exposure that the photo decodes to, of one curve."""
    values = torch.linspace(curve.black + 2 * CODE, curve.peak - 2 * CODE, 97, dtype=torch.float64)
    settings = {"elementwise": True, "floor": 1e-6, "label": f"{curve.name} {{}}"}
    # A filmic curve's derivative is the difference of terms that are up to 50 times as large (x near its white).
    options["extra"] = 64 * UNIT if curve.name in ("filmic", "aces") else 0.0
    encoded = compare(lambda x: {"f": curve.encode(x)}, {"x": exposures}, device, **settings | options)
    return encoded + compare(lambda v: {"decode": curve.decode(v)}, {"v": values}, device, **settings)


def _exposures(device):
    """Radiance 1 photographed for 2^-24 to 2^24 seconds, half-way between whole stops, by every curve."""
    times = 2.0 ** torch.arange(-24.0, 24.0, 0.37, dtype=torch.float64)
    for curve in map(response_by_name, CURVES):
        yield from _response_readings(curve, device, times, gradients=("x",))


def _odd_responses(device):
    """Curves that a file may hold: flat, steep, not monotone by noise, and clipped at both ends."""
    x = np.linspace(0, 1, 300)
    curves = {
        "flat": np.where(x < 0.3, x, np.where(x < 0.7, 0.3, x - 0.4 + 0.3)) / 0.9,
        "steep": 0.5 + 0.5 * np.tanh((x - 0.5) * 1000),
        "noisy": x**0.5 + np.random.default_rng(0).normal(0, 0.02, 300),
        "clipped": (x - 0.2) * 2,
    }
    at = torch.linspace(0.0013, 1.3, 211, dtype=torch.float64)
    for name, values in curves.items():
        curve = TabulatedResponse(name, x, np.clip(values, 0, 1))
        yield from _response_readings(curve, device, at)
        again = curve.decode(curve.encode(at.clamp_max(curve.clip_exposure).to(device, torch.float32)))
        yield count(f"{name}: not finite after encode and decode", not_finite(again))


def _extremes(device):
    """Check for a value within [0, 1] and a finite derivative everywhere."""
    wrong = 0
    for curve in map(response_by_name, CURVES):
        x = torch.tensor([0.0, 1e-45, 1e-38, 1e-20, 1e20, 3e38, math.inf], device=device, requires_grad=True)
        for encode in (curve.encode, curve.encode_extended):
            value = encode(x)
            (slope,) = torch.autograd.grad(value[:-1].sum(), x)
            wrong += not_finite(value[:-1], slope) + int((value < 0).sum())
        wrong += int(((curve.encode(x) > 1) | curve.encode(x).isnan()).sum())
    yield count("values or derivatives out of range", wrong)


def _zero_radiance(device):
    """Start from a black photo, and fuse log 0 = -infinity."""
    logs = torch.tensor([[-math.inf] * 3, [-200.0] * 3, [math.log(EXPOSURE_FLOOR)] * 3], device=device)
    fusion = _Fusion(0.2).to(device)
    yield count("not finite in fusion", not_finite(fusion(logs), NeuralExposureFusion.forward(fusion, logs)))
    decoded = torch.cat([response_by_name(name).decode(torch.zeros(1, device=device)) for name in CURVES])
    yield count("not finite in the start's logarithm", not_finite(decoded.clamp_min(EXPOSURE_FLOOR).log()))


class _Fusion(NeuralExposureFusion):
    """The fusion by its equations, without the table."""

    def __init__(self, sigma: float):
        super().__init__(response_by_name("srgb"), BRACKETS, 1.0, width=16)
        torch.nn.init.constant_(self.log_sigma, math.log(sigma))

    def forward(self, log_base):
        encoded = self._encode(log_base)
        return self.radiance_scale * (fusion_weights(encoded, *self._learned_tensors()) * encoded).sum(dim=0)


def _fusion_results(sigma: float, gain: float, device):
    """gain: of the last layer: logits reach a tenth of it."""
    fusion = _Fusion(sigma)
    generator = torch.Generator().manual_seed(0)
    log_base = torch.empty(400, 3, dtype=torch.float64).uniform_(-9, 4, generator=generator)
    last = fusion.weights[1].detach().double() * gain
    tensors = {"log_base": log_base, "log_sigma": fusion.log_sigma.detach().double(), "last": last}

    def fuse(log_base, log_sigma, last):
        """Evaluate the equations in the precision of the arguments."""
        parameters = {name: value.to(log_base) for name, value in fusion.named_parameters()}
        parameters |= {"log_sigma": log_sigma, "weights.1": last}
        return {"fused": torch.func.functional_call(fusion, parameters, (log_base,))}

    # Each logit is rounded by itself, at its own size; what differs by that much, the softmax sees as a factor.
    yield from compare(fuse, tensors, device, gradients=("last",), extra=ROUNDINGS * UNIT * gain / 10)
    leaves = {name: t.to(device, torch.float32).requires_grad_() for name, t in tensors.items()}
    fuse(*leaves.values())["fused"].sum().backward()
    yield count("derivatives not finite", not_finite(*(t.grad for t in leaves.values())))


def _sigma_limits(device):
    """Widths that float32 cannot hold are held at its limits, derivatives stay finite."""
    wrong = 0
    for log_sigma in (-1e3, -80.0, 80.0, 1e3):
        fusion = _Fusion(1.0).to(device)
        with torch.no_grad():
            fusion.log_sigma.fill_(log_sigma)
        log_base = torch.linspace(-9, 4, 300, device=device).reshape(100, 3).requires_grad_()
        value = fusion(log_base)
        value.sum().backward()
        wrong += not_finite(value, log_base.grad, *(p.grad for p in fusion.parameters()))
        wrong += int((value < -1e-6).sum())
    yield count("not finite or negative", wrong)


def _photos(device):
    """Compare the loss and its derivative."""
    noise = torch.rand(24, 20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    spot = torch.zeros_like(noise)
    spot[11, 7] = 1.0
    tensors = {"prediction": 0.05 + 0.9 * noise}
    for name, photo in (("clipped", torch.ones_like(noise)), ("black", torch.zeros_like(noise)), ("one pixel", spot)):
        options = {"gradients": ("prediction",), "label": f"{name} {{}}"}
        yield from compare(lambda x, photo=photo: {"loss": _loss(x, photo)}, tensors, device, **options)
    for name, photo, value in (("above white", 1.0, 3.0), ("below black", 0.0, -1.0)):
        prediction = torch.full((8, 8, 3), value, device=device, requires_grad=True)
        _loss(prediction, torch.full((8, 8, 3), photo, device=device)).backward()
        yield count(f"{name}: pixels that still pull", (prediction.grad != 0).sum())


def _loss(prediction, photo):
    """Return the training's loss between encoded values of a simulated and a black and white photo, [H, W, 3]."""
    codes = (255 * photo).to(prediction.device, torch.uint8)
    target = Target(codes, code_scale(255, None, prediction.device, dtype=prediction.dtype))
    render = PhotoRender(prediction, None, None, None)  # pyright: ignore[reportArgumentType]
    return ldr_loss(render, target, LossConfig())


def _clipped_light(device):
    """Check a disk that clips: light around white, far above it, nearly equal, and one pixel at 2^100."""
    noise = torch.randn(11, 13, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(11), torch.arange(13), indexing="ij")
    codes = torch.where(((y - 5) ** 2 + (x - 6) ** 2 < 20)[..., None], 255, 90).expand(11, 13, 3).to(torch.uint8)
    spike = torch.full_like(noise, 4.0)
    spike[5, 6] = 2.0**100
    cases = {
        "around white": noise.exp(),
        "far above": 2**20 * noise.exp(),
        "nearly equal": 4 + 0.1 * noise,
        "one spike": spike,
    }
    weights = ClippedWeights(smoothness=1.0)
    for name, image in cases.items():

        def energy(image):
            return {"energy": clipped_light_energy(image, codes.to(image.device), 1.0, weights)}

        # A logarithm of float32 is known to some units of its own, whatever is left of a difference of two.
        options = {"gradients": ("image",), "extra": 64 * UNIT, "label": f"{name} {{}}"}
        yield from compare(energy, {"image": image}, device, **options)


def _similarity(device):
    """Check images of 1 x 1, of odd size, flat, nearly equal and tiny ones."""
    generator = torch.Generator().manual_seed(0)
    for name, shape, change in (
        ("1 x 1", (1, 1, 3), lambda a: (a, 1 - a)),
        ("odd", (13, 7, 3), lambda a: (a, 1 - a)),
        ("white", (9, 30, 3), lambda a: (1 - 1e-3 * a, torch.ones_like(a))),
        ("near-equal", (16, 16, 3), lambda a: (a, a + 1e-4)),
        ("tiny", (16, 16, 3), lambda a: (a, a * 1e-20)),
    ):
        a, b = change(torch.rand(shape, generator=generator, dtype=torch.float64))
        options = {"gradients": ("a",), "extra": VARIANCE_ERROR, "label": f"{name} {{}}"}
        yield from compare(lambda a, b: {"ssim": ssim(a, b)}, {"a": a, "b": b}, device, **options)


_case = partial(Case, group="light")
LIGHT_CASES = (
    _case("exposures", "exposures from 2^-24 to 2^24 s through every response", _exposures),
    _case("responses", "flat, steep, noisy and clipped curves", _odd_responses),
    _case("exposure-limits", "zero, denormal, huge and infinite exposures", _extremes),
    _case("log-zero", "the logarithm of zero radiance", _zero_radiance),
    _case("sigma-small", "fusion with sigma 1e-3", partial(_fusion_results, 1e-3, 1.0)),
    _case("sigma-large", "fusion with sigma 1e3", partial(_fusion_results, 1e3, 1.0)),
    _case("sigma-limits", "fusion with sigma towards 0 and infinity", _sigma_limits),
    _case("logits", "softmax logits of +-1e4", partial(_fusion_results, 1e3, 1e5),
         note="a logit of 1e4 is known to 1e-3 in float32, and the weights of the brackets to no better"),
    _case("photos", "photos all clipped, all black, and with one bright pixel", _photos),
    _case("clipped-light", "clipped light near white, far above, nearly equal, and one pixel at 2^100", _clipped_light),
    _case("similarity", "SSIM of flat, equal, opposite and tiny images", _similarity),
)  # fmt: skip
