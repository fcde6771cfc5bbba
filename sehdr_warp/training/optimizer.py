"""Adam over the Gaussians, the fusion and a learned response, with 3DGS's learning rates; and the moving average.

For steps of B photos, learning rates are multiplied by the square root of B, and the decays of the moments are raised
to the power of B: gradients of photos count as independent, so that B photos move a parameter about as far, and with
the same variance, as B steps of one photo (the rule of Grendel-GS, ICLR 2025, for 3D Gaussians).
"""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from ..model.adam import BETAS, FIRST_HARMONIC, Adam
from ..model.gaussians import PARAMETER_NAMES, Gaussians
from ..model.radiance_field import RadianceField
from ..rasterizer import HarmonicsGradients
from ..runs.checkpoint import under
from ..runs.config import Config

# Higher harmonics are 3/4 of all parameters and the Adam step is bandwidth-bound, so on a GPU each step updates
# half of them: every second block of coefficients, in turn.
SH_UPDATE_INTERVAL = 2
SH_INTERVAL_FROM = 4000  # Steps of the shortest training to which SH_UPDATE_INTERVAL applies; shorter ones lose quality
SAMPLES_PER_WINDOW = 10  # Of the moving average; consecutive iterations differ too little to be worth the time
WINDOWS = 5  # Windows before the end at which the average begins; older samples would weigh less than 1 %


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


class FlatGradients:
    """The gradients of all parameters of an optimizer in one buffer, which ranks exchange.

    Behind them are two numbers of the step: its loss, and whether there were more intersections than memory.
    """

    def __init__(self, optimizer: Adam, rank: int, count: int, *, defer_sh: bool):
        """Allocate the buffer of rank `rank` of `count`; if `defer_sh`, harmonics are exchanged in factored form."""
        self.all = dict(_parameters(optimizer))
        factored = tuple(f"{name}." for name in FIRST_HARMONIC) if defer_sh else ()
        self.parameters = [parameter for name, parameter in self.all.items() if not name.startswith(factored)]
        self._means, self._rank, self._count = self.all["means.0."], rank, count
        shapes = [parameter.shape for parameter in self.parameters]
        shapes += [(count, *self._means.shape), (count, 3)] if defer_sh else []
        sizes = [math.prod(shape) for shape in shapes]
        self.buffer = torch.zeros(sum(sizes) + 2, device=self._means.device)
        *parts, self.numbers = self.buffer.split([*sizes, 2])
        self._views = [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
        self._with_gradient: list[int] = []
        self._degree: int | None = None

    def fits(self, optimizer: Adam) -> bool:
        """Return whether the optimizer still has the same parameters."""
        return all(self.all[name] is parameter for name, parameter in _parameters(optimizer))

    @torch.no_grad()
    def collect(self, loss: Tensor, overflow: Tensor | None, harmonics: HarmonicsGradients | None = None) -> None:
        """Move the parameters' gradients to the buffer, with the numbers of the step."""
        gradients = {k: value.grad for k, value in enumerate(self.parameters) if value.grad is not None}
        # Else the mean would hold gradients of an earlier step.
        assert self._with_gradient in ([], [*gradients]), "all steps have gradients of the same parameters"
        self._with_gradient = [*gradients]
        torch._foreach_copy_([self._views[k] for k in gradients], [*gradients.values()])
        self._degree = None
        if harmonics is not None:
            # The slots of other ranks are zero, so that the sum over the ranks gathers all.
            grad_colors, positions = (part.zero_() for part in self._views[-2:])
            grad_colors[self._rank], positions[self._rank] = harmonics.grad_colors[0], harmonics.positions[0]
            self._degree = harmonics.degree
        self.numbers[0] = loss.detach()
        self.numbers[1] = torch.zeros_like(loss) if overflow is None else overflow.to(loss.dtype)
        for k in self._with_gradient:
            self.parameters[k].grad = None

    def distribute(self) -> tuple[Tensor, Tensor, HarmonicsGradients | None]:
        """Set the parameters' gradients to the buffer, after it was averaged over the ranks.

        Returns:
            Loss, whether a rank had more intersections than memory ([] bool), and factored gradients of the harmonics.
        """
        for k in self._with_gradient:
            self.parameters[k].grad = self._views[k]
        harmonics = None
        if self._degree is not None:
            grad_colors, positions = self._views[-2:]
            # Positions are no mean: each is in one rank's slot, and all_reduce_mean() has divided it by the count.
            harmonics = HarmonicsGradients(grad_colors, positions * self._count, self._means, self._degree)
        return self.numbers[0], self.numbers[1] > 0, harmonics


def optimizer_tensors(optimizer: Adam, batch: int = 1) -> dict[str, Tensor]:
    """Return Adam's state as named tensors, `<group>.<index>.<key>`, for a checkpoint.

    Step counts are in photos, so that a training can continue with another number of ranks; `batch` is the photos of a
    step.
    """
    return {
        f"{prefix}{key}": value * batch if key == "step" and batch > 1 else value
        for prefix, parameter in _parameters(optimizer)
        for key, value in optimizer.state.get(parameter, {}).items()
    }


def load_optimizer_tensors(optimizer: Adam, tensors: dict[str, Tensor], batch: int = 1) -> None:
    """Continue from optimizer_tensors()."""
    for prefix, parameter in _parameters(optimizer):
        if state := under(tensors, prefix):
            optimizer.state[parameter] = {
                key: value.to(parameter.device, copy=True).reshape(() if key == "step" else parameter.shape)
                for key, value in state.items()
            }
            optimizer.state[parameter]["step"] /= batch


def _parameters(optimizer: Adam) -> Iterator[tuple[str, Tensor]]:
    """Yield a name prefix and a parameter for each parameter of an optimizer."""
    for group in optimizer.param_groups:
        for index, parameter in enumerate(group["params"]):
            yield f"{group['name']}.{index}.", parameter


class MovingAverage:
    """Exponential moving average of Gaussians over about schedule.ema_window of the last iterations.

    With it no single photo dominates the end of a training. It starts after the last change of the number of Gaussians.

    Attributes:
        every: Iterations between samples.
        weight: Weight of a new sample; 1 disables the average.
        first: Iteration after which samples are taken.
        means: The averages by parameter name; empty before the first sample.
    """

    def __init__(self, config: Config, last_change: int):
        """Create an average without samples; `last_change` is the last iteration that changes the Gaussians' number."""
        self.total = config.schedule.iterations
        window = config.scaled(config.schedule.ema_window) if config.schedule.ema_window else 1
        self.every = max(1, window // SAMPLES_PER_WINDOW)
        self.weight = self.every / window
        self.first = max(self.total - WINDOWS * window, last_change)
        self.means: dict[str, Tensor] = {}

    @torch.no_grad()
    def update(self, iteration: int, step_batch: int, gaussians: Gaussians) -> None:
        """Update the average after a step of `step_batch` iterations; after the last one, copy it to the Gaussians."""
        if self.weight == 1 or iteration <= self.first:
            return
        if iteration % self.every < step_batch or iteration >= self.total:
            now = gaussians.tensors()
            if self.means:
                # A plain mean at first, so that the first sample does not weigh more than others.
                samples = iteration // self.every - self.first // self.every + (iteration % self.every >= step_batch)
                means = [self.means[name] for name in now]
                torch._foreach_lerp_(means, list(now.values()), max(self.weight, 1 / max(1, samples)))
            else:
                self.means = {name: values.clone() for name, values in now.items()}
        if iteration >= self.total:
            for name, values in gaussians.tensors().items():
                values.copy_(self.means[name])
            self.means = {}
