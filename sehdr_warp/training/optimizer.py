"""Adam over the Gaussians, the fusion and a learned response, with 3DGS's learning rates.

For steps of B photos, learning rates are multiplied by the square root of B, and the decays of the moments are raised
to the power of B: gradients of photos count as independent, so that B photos move a parameter about as far, and with
the same variance, as B steps of one photo (the rule of Grendel-GS, ICLR 2025, for 3D Gaussians).
"""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from ..model.adam import BETAS, Adam
from ..model.gaussians import PARAMETER_NAMES
from ..model.radiance_field import RadianceField
from ..runs.checkpoint import part_of
from ..runs.config import Config

# Higher harmonics are 3/4 of all parameters and the Adam step is bandwidth-bound, so on a GPU each step updates
# half of them: every second block of coefficients, in turn.
SH_UPDATE_INTERVAL = 2
SH_INTERVAL_FROM = 4000  # Steps of the shortest training to which SH_UPDATE_INTERVAL applies; shorter ones lose quality


def make_optimizer(field: RadianceField, config: Config, batch: int = 1) -> Adam:
    """Create an optimizer with a named group for each parameter of the Gaussians, the fusion and a learned response.

    On a GPU, counters and learning rates are tensors on the device, so that steps can be captured as CUDA graphs. A
    step has `batch` photos.
    """
    device = field.gaussians.means.device
    rates = {name: getattr(config.optimizer, name) for name in PARAMETER_NAMES}
    groups = [{"name": name, "params": [getattr(field.gaussians, name)], "lr": rate} for name, rate in rates.items()]
    if field.fusion is not None:
        groups.append({"name": "fusion", "params": list(field.fusion.parameters()), "lr": config.optimizer.fusion})
    if isinstance(field.response, torch.nn.Module):
        learned = list(field.response.parameters())
        groups.append({"name": "response", "params": learned, "lr": config.optimizer.response})
    for group in groups:
        rate = group["lr"] * math.sqrt(batch)
        group["lr"] = torch.tensor(rate, device=device) if device.type == "cuda" else rate
    interval = SH_UPDATE_INTERVAL if config.schedule.iterations >= SH_INTERVAL_FROM * batch else 1
    return Adam(groups, betas=(BETAS[0] ** batch, BETAS[1] ** batch), sh_update_interval=interval)


def means_rate(config: Config, iteration: int, batch: int = 1) -> float:
    """Return the learning rate of the means: exponential from `means` to `means_final`, normalized units."""
    rates = config.optimizer
    part = min(iteration / config.schedule.iterations, 1.0)
    return math.sqrt(batch) * rates.means * (rates.means_final / rates.means) ** part


def set_means_rate(optimizer: Adam, rate: float) -> None:
    """Set the learning rate of the means for the next step."""
    group = optimizer.param_groups[PARAMETER_NAMES.index("means")]
    if isinstance(group["lr"], Tensor):
        group["lr"].fill_(rate)
    else:
        group["lr"] = rate


def optimizer_tensors(optimizer: Adam, batch: int = 1) -> dict[str, Tensor]:
    """Return Adam's state as named tensors, `<group>.<index>.<key>`, for a checkpoint.

    Step counts are in photos, so that a training can continue with another number of ranks; `batch` is the photos of a
    step.
    """
    return {
        f"{prefix}{key}": value * batch if key == "step" and batch > 1 else value
        for prefix, parameter in named_parameters(optimizer)
        for key, value in optimizer.state.get(parameter, {}).items()
    }


def load_optimizer_tensors(optimizer: Adam, tensors: dict[str, Tensor], batch: int = 1) -> None:
    """Continue from optimizer_tensors()."""
    for prefix, parameter in named_parameters(optimizer):
        if state := part_of(tensors, prefix):
            optimizer.state[parameter] = {
                key: value.to(parameter.device, copy=True).reshape(() if key == "step" else parameter.shape)
                for key, value in state.items()
            }
            optimizer.state[parameter]["step"] /= batch


def named_parameters(optimizer: Adam) -> Iterator[tuple[str, Tensor]]:
    """Yield a name prefix and a parameter for each parameter of an optimizer."""
    for group in optimizer.param_groups:
        for index, parameter in enumerate(group["params"]):
            yield f"{group['name']}.{index}.", parameter
