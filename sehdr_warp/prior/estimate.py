"""Estimates of the light of clipped pixels, by the weights that come with the package."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InputError
from .network import LightNetwork, network_input

WEIGHTS = Path(__file__).with_name("clipped_light.safetensors")
LARGEST = 160  # Pixels of the longer side that the network sees; larger photos are averaged down
MOST_BYTES = 3_000_000  # Of a weights file


@dataclass(frozen=True)
class LightEstimate:
    """What clipped pixels probably hold, in stops (log2) over white; [H, W, 3] each.

    mean: expected excess over white, at least 0. deviation: its standard deviation. Both mean nothing at values that
    are not clipped.
    """

    mean: Tensor
    deviation: Tensor


class LightPrior:
    """A loaded network, on one device.

    Args:
        network: with its weights.
        deviation_scale: factor of the deviations, fitted on photos that the network was not trained on.
    """

    def __init__(self, network: LightNetwork, deviation_scale: float = 1.0):
        self.network, self.deviation_scale = network.eval(), deviation_scale

    @torch.no_grad()
    def estimate(self, exposure: Tensor, clipped: Tensor) -> LightEstimate:
        """Estimate the light of a photo's clipped values.

        Args:
            exposure: [H, W, 3] decoded, float32, in units of the exposure that the photo shows as white.
            clipped: [H, W, 3] bool.

        Returns:
            The estimate at every pixel, on the photo's device; photos larger than LARGEST are seen by the network
            averaged down, and the result is interpolated.
        """
        parameter = next(self.network.parameters())
        picture = torch.cat([exposure, clipped.to(exposure)], 2).permute(2, 0, 1)[None].to(parameter)
        size = picture.shape[2:]
        if max(size) > LARGEST:
            smaller = [max(1, round(side * LARGEST / max(size))) for side in size]
            picture = F.interpolate(picture, size=smaller, mode="area")
        found = self.network(network_input(picture[:, :3], picture[:, 3:]))
        if max(size) > LARGEST:
            found = [F.interpolate(values, size=size, mode="bilinear", align_corners=False) for values in found]
        mean, deviation = (values[0].permute(1, 2, 0).to(exposure) for values in found)
        return LightEstimate(mean, deviation * self.deviation_scale)


def load_prior(device: torch.device | str = "cpu", path: Path = WEIGHTS) -> LightPrior:
    """Return the prior of a weights file on a device.

    Raises:
        InputError: for a file that is missing, damaged or no such weights.
    """
    return _load(str(device), path)


@lru_cache(maxsize=2)
def _load(device: str, path: Path) -> LightPrior:
    from safetensors import SafetensorError, safe_open

    remedy = "install sehdr-warp again, or train with loss.light_prior_weight=0"
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
    return LightPrior(network.to(device), scale)
