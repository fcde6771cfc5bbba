"""Adam over the Gaussians and the fusion, with 3DGS's learning rates.

Where a step is made of a batch of B photos, rates are multiplied by the square root of B, and the moments' decays
raised to the power of B: gradients of photos are taken as independent, so that B photos move a parameter about as far,
and with the same variance, as B steps of one do (the rule of Grendel-GS, ICLR 2025, for 3D Gaussians).
"""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from ..model.adam import BETAS, FIRST_HARMONIC, Adam
from ..model.gaussians import PARAMETER_NAMES
from ..model.radiance_field import RadianceField
from ..rasterizer import HarmonicsGradients
from ..rasterizer.training_step import judge_step, norms
from ..runs.checkpoint import under
from ..runs.config import Config

TURNS = 2  # Parts of the higher harmonics, three quarters of all numbers, that a GPU steps in turn: memory is slow
IN_TURN_FROM = 4000  # Steps of a training that is as good by that: shorter ones lack them


def make_optimizer(field: RadianceField, config: Config, extent: float, batch: int = 1) -> Adam:
    """One named group for each parameter of the Gaussians, one for the fusion, one for a learned response. On a GPU
    counters and rates live on the device, so that steps can be recorded in a CUDA graph. batch: photos in a step."""
    device = field.gaussians.means.device
    rates = {name: getattr(config.optimizer, name) for name in PARAMETER_NAMES}
    rates["means"] *= extent
    groups = [{"name": name, "params": [getattr(field.gaussians, name)], "lr": rate} for name, rate in rates.items()]
    if field.fusion is not None:
        groups.append({"name": "fusion", "params": list(field.fusion.parameters()), "lr": config.optimizer.fusion})
    if isinstance(field.response, torch.nn.Module):
        learned = list(field.response.parameters())
        groups.append({"name": "response", "params": learned, "lr": config.optimizer.response})
    for group in groups:
        rate = group["lr"] * math.sqrt(batch)
        group["lr"] = torch.tensor(rate, device=device) if device.type == "cuda" else rate
    turns = TURNS if config.schedule.iterations >= IN_TURN_FROM * batch else 1
    return Adam(groups, betas=(BETAS[0] ** batch, BETAS[1] ** batch), turns=turns)


def means_rate(config: Config, extent: float, iteration: int, batch: int = 1) -> float:
    """The learning rate of the positions at an iteration: exponential from `means` to `means_final`, times extent."""
    rates = config.optimizer
    part = min(iteration / config.schedule.iterations, 1.0)
    return math.sqrt(batch) * extent * rates.means * (rates.means_final / rates.means) ** part


def set_means_rate(optimizer: Adam, rate: float) -> None:
    """Sets the learning rate of the positions for the next step."""
    group = optimizer.param_groups[PARAMETER_NAMES.index("means")]
    if isinstance(group["lr"], Tensor):
        group["lr"].fill_(rate)
    else:
        group["lr"] = rate


def guarded_step(
    optimizer: Adam,
    loss: Tensor,
    incomplete: Tensor | None = None,
    harmonics: HarmonicsGradients | None = None,
    *,
    tally: Tensor | None = None,
    pairs: Tensor | None = None,
    live: Tensor | None = None,
) -> Tensor:
    """One step of Adam, or none if the loss or a gradient is not finite or the rendering was incomplete; decided on the
    device, without waiting for it. A scalar float tensor: 1 if the step was made, else 0. tally, pairs: as of
    judge_step(); live: as of Adam.step()."""
    gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
    gradients += [] if harmonics is None else [harmonics.by_values]
    skipped, made = judge_step(loss, norms(gradients), incomplete, tally, pairs)
    optimizer.step(skipped, made, harmonics, live)
    return made


class FlatGradients:
    """The gradients of all parameters of an optimizer in one buffer, which ranks exchange; those of harmonics as their
    factors where they come so. Behind them two numbers of the step: its loss, and whether its rendering was incomplete.

    place: of this rank among `count`. factored: whether the gradients of harmonics come as their factors.
    """

    def __init__(self, optimizer: Adam, place: int, count: int, *, factored: bool):
        groups = {group["name"]: group["params"] for group in optimizer.param_groups}
        self.all = _parameters(optimizer)
        self.parameters = [
            parameter
            for name, parameters in groups.items()
            for parameter in parameters
            if not (factored and name in FIRST_HARMONIC)
        ]
        self._means, self._place, self._count = groups["means"][0], place, count
        shapes = [parameter.shape for parameter in self.parameters]
        shapes += [(count, *self._means.shape), (count, 3)] if factored else []
        sizes = [math.prod(shape) for shape in shapes]
        self.buffer = torch.zeros(sum(sizes) + 2, device=self._means.device)
        *parts, self.numbers = self.buffer.split([*sizes, 2])
        self._views = [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
        self._given: Sequence[int] = ()
        self._degree: int | None = None

    def fits(self, optimizer: Adam) -> bool:
        """Whether these are still the optimizer's parameters."""
        return all(ours is theirs for ours, theirs in zip(self.all, _parameters(optimizer), strict=True))

    @torch.no_grad()
    def take(self, loss: Tensor, incomplete: Tensor | None, harmonics: HarmonicsGradients | None = None) -> None:
        """Moves the parameters' gradients into the buffer, with a step's numbers."""
        self._given = [k for k, parameter in enumerate(self.parameters) if parameter.grad is not None]
        given = [self.parameters[k].grad for k in self._given]
        torch._foreach_copy_([self._views[k] for k in self._given], given)
        self._degree = None
        if harmonics is not None:
            # The others' places are zero: the sum over the ranks gathers all.
            by_values, positions = (part.zero_() for part in self._views[-2:])
            by_values[self._place], positions[self._place] = harmonics.by_values[0], harmonics.positions[0]
            self._degree = harmonics.degree
        self.numbers[0] = loss.detach()
        self.numbers[1] = torch.zeros_like(loss) if incomplete is None else incomplete.to(loss.dtype)
        for k in self._given:
            self.parameters[k].grad = None

    def give(self) -> tuple[Tensor, Tensor, HarmonicsGradients | None]:
        """The buffer's parts as the gradients of the parameters that had one; loss, incomplete [] bool, and what the
        harmonics' gradients are the product of. To be called on the mean over the ranks."""
        for k in self._given:
            self.parameters[k].grad = self._views[k]
        harmonics = None
        if self._degree is not None:
            by_values, positions = self._views[-2:]
            harmonics = HarmonicsGradients(by_values, positions * self._count, self._means, self._degree)
        return self.numbers[0], self.numbers[1] > 0, harmonics


def _parameters(optimizer: Adam) -> list[Tensor]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def optimizer_tensors(optimizer: Adam, batch: int = 1) -> dict[str, Tensor]:
    """Adam's state as named tensors, `<group>.<index>.<key>`, for a checkpoint. Steps count photos there, of which one
    makes `batch`: a training may go on with another."""
    states = {prefix: optimizer.state.get(parameter, {}) for prefix, parameter in _named(optimizer)}
    return {
        f"{prefix}{key}": value * batch if key == "step" and batch > 1 else value
        for prefix, state in states.items()
        for key, value in state.items()
    }


def load_optimizer_tensors(optimizer: Adam, tensors: dict[str, Tensor], batch: int = 1) -> None:
    """Takes up what optimizer_tensors gave."""
    for prefix, parameter in _named(optimizer):
        if state := under(tensors, prefix):
            optimizer.state[parameter] = {
                key: value.to(parameter.device, copy=True).reshape(() if key == "step" else parameter.shape)
                for key, value in state.items()
            }
            optimizer.state[parameter]["step"] /= batch


def _named(optimizer: Adam) -> Iterator[tuple[str, Tensor]]:
    for group in optimizer.param_groups:
        for index, parameter in enumerate(group["params"]):
            yield f"{group['name']}.{index}.", parameter
