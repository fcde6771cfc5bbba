"""Estimates of the light of clipped pixels, by the weights that come with the package."""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InputError
from .network import LightNetwork, network_input

WEIGHTS = Path(__file__).with_name("clipped_light.safetensors")
LARGEST = 160  # Pixels of the longer side that the network sees; larger photos are averaged down
MOST_BYTES = 3_000_000  # Of a weights file
ESTIMATE_DEVIATION = 1.5
"""Standard deviation, stops, of an estimate of light as bright as white, by which the loss weighs it."""
VARIANCE_SHARE = 0.5
"""Share of the variance that the expected light counts: exp(mean + share * deviation^2 / 2), of natural logarithms.
With 1 it is the mean of a log-normal value, whose rare large errors light a scene far too brightly; with 0 it is the
median, below the mean light of small lamps. In the rooms of docs/reports/quality.md where much clips, at exposures 2 to
4, irradiance was off by 22 % in the mean with 0.5 and by 25 % with 1, but 15 lights were lost in place of 12."""
LARGE_DEVIATION_POWER = 1.5
"""Power by which deviations over one stop are widened where they say how sure light is. Per region, in photos of
panoramas that no training used, 68 % of the estimates are off by at most 1.1, 1.5, 1.9 and 3.3 stops where the network
states 1.1, 1.4, 1.7 and 2.2."""
ESTIMATE_POWER = 0.5
"""Power of the expected light to which the estimates of several photos weigh. Photos disagree about a lamp by a factor,
which is about log-normal with a deviation s. Logarithms that weigh by the root of the light then have the mean + s^2/2,
which is the logarithm of the mean light: the mean of expected light has no bias, whatever errors photos share."""


@dataclass(frozen=True)
class LightEstimate:
    """Estimate of clipped pixels in stops (log2) over white; [h, w, 3] each.

    mean: expected excess over white, at least 0. deviation: its standard deviation. Both mean nothing at values that
    are not clipped.
    """

    mean: Tensor
    deviation: Tensor


@dataclass(frozen=True)
class ClippedLight:
    """Estimates of a photo's clipped light from all sources; float16, 0 where nothing is clipped or known."""

    # [h, w, 6], as clipped_light_energy() takes it: for each channel the natural logarithm of the expected light
    # over white, and then the root of its weight in a training
    log_light: Tensor
    certainty: Tensor  # [h, w, 3], 1 / the deviation of that logarithm


class LightPrior:
    """A loaded network, on one device."""

    def __init__(self, network: LightNetwork, deviation_scale: float = 1.0):
        """Keep a network, and the factor of its deviations, fitted on photos that it was not trained on."""
        self.network, self.deviation_scale = network.eval(), deviation_scale

    @torch.no_grad()
    def estimate(self, exposure: Tensor, clipped: Tensor) -> LightEstimate:
        """Estimate the light of a photo's clipped values.

        Args:
            exposure: [H, W, 3] decoded, float32, in units of the exposure that the photo shows as white.
            clipped: [H, W, 3] bool.

        Returns:
            The estimate on the photo's device, at the size of `coarse_size`.
        """
        parameter = next(self.network.parameters())
        picture = torch.cat([exposure, clipped.to(exposure)], 2).permute(2, 0, 1)[None].to(parameter)
        picture = F.interpolate(picture, size=coarse_size(*exposure.shape[:2]), mode="area")
        prediction = self.network(network_input(picture[:, :3], picture[:, 3:]))
        mean, deviation = (values[0].permute(1, 2, 0).to(exposure) for values in prediction)
        return LightEstimate(mean, deviation * self.deviation_scale)


class Prior(Protocol):
    """An estimator of clipped light: LightPrior, or another for photos of cameras that are not pinholes."""

    def estimate(self, exposure: Tensor, clipped: Tensor) -> LightEstimate:
        """Estimate the light of a photo's clipped values, as LightPrior does."""
        ...


def coarse_size(height: int, width: int) -> tuple[int, int]:
    """Return the size at which the network sees a photo: the photo's own up to LARGEST, else averaged down to it."""
    part = min(1.0, LARGEST / max(height, width))
    return max(1, round(height * part)), max(1, round(width * part))


@torch.no_grad()
def combined_estimates(
    exposure: Tensor,
    clipped: Tensor,
    prior: Prior | None,
    stated_light: Tensor | None = None,
    stated_deviation: float = 0.0,
) -> ClippedLight:
    """Return what is known of a photo's clipped light, from the prior and from what its file states.

    Args:
        exposure: [H, W, 3], as of LightPrior.estimate.
        clipped: [H, W, 3] bool.
        prior: LightPrior, or another for a photo by a camera that is not a pinhole; None leaves it out.
        stated_light: [H, W, 3] in multiples of white, at least 1 where it is known, as View.light_above_white has it.
        stated_deviation: standard deviation of its natural logarithm.

    Returns:
        What is known, at the size of the prior's estimate, or of `coarse_size`. Two estimates of a value are averaged
        by their precisions. In a training estimates of the prior weigh by their light, not by their deviations.
    """
    estimate = None if prior is None else prior.estimate(exposure, clipped)
    size = coarse_size(*exposure.shape[:2]) if estimate is None else (estimate.mean.shape[0], estimate.mean.shape[1])
    total = exposure.new_zeros(*size, 3)
    precision, stated_precision = torch.zeros_like(total), torch.zeros_like(total)
    if estimate is not None:
        deviation = estimate.deviation * math.log(2)
        precision += (math.log(2) * torch.maximum(estimate.deviation, estimate.deviation**LARGE_DEVIATION_POWER)) ** -2
        # Between the mean of light and that of its logarithm: lamps have more of their energy than by the latter.
        total += precision * (estimate.mean * math.log(2) + VARIANCE_SHARE * deviation.square() / 2)
    if stated_light is not None and stated_deviation > 0:
        has_value = (clipped & (stated_light >= 1)).to(exposure)
        share, light = (
            _average(values, size) for values in (has_value, has_value * stated_light.to(exposure).clamp_min(1).log())
        )
        stated_precision = (share > 0).to(exposure) / stated_deviation**2
        total += stated_precision * light / share.clamp_min(1e-6)
        precision += stated_precision
    some = _average(clipped.to(exposure), size) > 0
    mean = torch.where(some, total / precision.clamp_min(1e-12), 0)
    weight = stated_precision
    if prior is not None:
        weight = weight + torch.exp(ESTIMATE_POWER * mean) / (ESTIMATE_DEVIATION * math.log(2)) ** 2
    roots = [torch.where(some, values.sqrt(), 0) for values in (weight, precision)]
    return ClippedLight(torch.cat([mean, roots[0]], 2).half(), roots[1].half())


def _average(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Return [H, W, 3] averaged by area to [h, w, 3]."""
    return F.interpolate(values.permute(2, 0, 1)[None], size=size, mode="area")[0].permute(1, 2, 0)


def load_prior(device: torch.device | str = "cpu", path: Path = WEIGHTS) -> LightPrior:
    """Return the prior of a weights file on a device.

    Raises:
        InputError: for a file that is missing, damaged or no such weights.
    """
    return _load(str(device), path)


@lru_cache(maxsize=2)
def _load(device: str, path: Path) -> LightPrior:
    from safetensors import SafetensorError, safe_open

    remedy = "install sehdr-warp again, or train with --loss.light-prior=false"
    if not path.is_file():
        raise InputError(path, "the weights of the prior for clipped light are missing", remedy)
    if path.stat().st_size > MOST_BYTES:
        raise InputError(path, f"has {path.stat().st_size} bytes, more than {MOST_BYTES}", remedy)
    try:
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 (no mapping)
            scale = float((file.metadata() or {}).get("deviation_scale", 1.0))
        network = LightNetwork(tensors["out.weight"].shape[1])
        network.load_state_dict(tensors)
    except (SafetensorError, OSError, LookupError, RuntimeError, ValueError) as error:
        problem = f"is not the weights of the prior for clipped light ({str(error).splitlines()[0]:.100})"
        raise InputError(path, problem, remedy) from None
    if not all(bool(values.isfinite().all()) for values in tensors.values()):
        raise InputError(path, "holds weights that are not finite", remedy)
    if not 0 < scale < math.inf:
        raise InputError(path, f"states deviation_scale {scale:g}, which is not a positive number", remedy)
    return LightPrior(network.to(device), scale)
