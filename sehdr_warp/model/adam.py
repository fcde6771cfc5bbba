"""Adam over groups of parameters, without torch.optim, whose import loads torch's compiler and takes two seconds."""

from collections import defaultdict
from collections.abc import Iterable

import torch
from torch import Tensor

from ..rasterizer import HarmonicsGradients
from ..rasterizer.ops.step_updates import AdamStep, StepFlags, adam_steps, harmonics_adam_step
from .gaussians import PARAMETER_NAMES

FIRST_HARMONIC = {"harmonics_dc": 0, "harmonics_rest": 1}
"""Index of the first harmonic in each parameter group that holds harmonics."""
BETAS = 0.9, 0.999
EPSILON = 1e-15  # As in 3DGS: the gradients of a single Gaussian are small compared with Adam's usual 1e-8


class Adam:
    """Adam (Kingma and Ba 2015) with few launches, each for several parameters.

    `param_groups` and `state` are laid out as in torch.optim.Adam.

    Attributes:
        param_groups: Dictionaries with "name", "params" and "lr".
        state: For each parameter "step", "exp_avg" and "exp_avg_sq".
        betas: Decays of the first and the second moments.
        sh_update_interval: The harmonics above degree 0 are divided into this many parts, of which each step updates
            one, if their gradients come in factored form.
        trained_rows: Number of Gaussians that are trained, the first ones; the others stay, and have no moments. None
            trains all. Set it before the first step.
    """

    trained_rows: int | None

    def __init__(self, groups: list[dict], betas: tuple[float, float] = BETAS, sh_update_interval: int = 1):
        """Create an optimizer without state."""
        self.param_groups, self.betas = groups, betas
        self.sh_update_interval, self.trained_rows = sh_update_interval, None
        self.state: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict)

    def zero_grad(self) -> None:
        """Drop the gradients of all parameters."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def moments(self, parameters: Iterable[Tensor]) -> list[Tensor]:
        """Return the first and second moments of those parameters that have been updated at least once."""
        states = (self.state[parameter] for parameter in parameters if parameter in self.state)
        return [state[key] for state in states for key in ("exp_avg", "exp_avg_sq")]

    @torch.no_grad()
    def step(
        self,
        flags: StepFlags | None = None,
        harmonics: HarmonicsGradients | None = None,
        active_count: Tensor | None = None,
    ) -> None:
        """Update all parameters that have a gradient.

        Args:
            flags: Whether the step is skipped, which leaves parameters, moments and step counts as they are; by default
                it is applied.
            harmonics: Gradients of the harmonics in factored form, for groups whose parameters have no gradient of
                their own.
            active_count: [1] int32, number of Gaussians, if parameters have more rows; the gradients of the other rows
                are 0.
        """
        pairs = self._with_gradient(factored=harmonics is not None)
        parameters = [parameter for _, parameter in pairs]
        if flags is None:
            flags = StepFlags(parameters[0].new_zeros(()), parameters[0].new_ones(()))
        self._create_states(parameters)
        # A list on both sides: torch reads a single tensor on the host, which CUDA graph capture does not allow.
        steps = [self.state[p]["step"] for p in parameters]
        torch._foreach_add_(steps, [flags.applied] * len(steps))  # pyright: ignore[reportPrivateImportUsage]
        steps_with_gradient = []
        options: dict = {"betas": self.betas, "epsilon": EPSILON, "active_count": active_count}
        for group, parameter in pairs:
            first, second, step = (self.state[parameter][key] for key in ("exp_avg", "exp_avg_sq", "step"))
            values = _first_rows(parameter.detach(), first)
            if parameter.grad is not None:
                width = values.numel() // len(values) if group.get("name") in PARAMETER_NAMES else 0
                gradient = _first_rows(parameter.grad.contiguous(), first)
                steps_with_gradient.append(AdamStep(values, gradient, first, second, step, group["lr"], width))
            elif harmonics is not None:
                start = FIRST_HARMONIC[group["name"]]
                interval = self.sh_update_interval if start else 1
                arguments = values, start, harmonics, first, second, step, flags.skipped
                harmonics_adam_step(*arguments, rate=group["lr"], update_interval=interval, **options)
        adam_steps(steps_with_gradient, flags.skipped, **options)

    def _with_gradient(self, *, factored: bool) -> list[tuple[dict, Tensor]]:
        """Return group and parameter of all that have a gradient; those of factored harmonics come first.

        The gradients of factored harmonics depend on the means before the step.
        """
        names = FIRST_HARMONIC if factored else ()
        pairs = [(group, parameter) for group in self.param_groups for parameter in group["params"]]
        pairs = [pair for pair in pairs if pair[1].grad is not None or pair[0].get("name") in names]
        return sorted(pairs, key=lambda pair: pair[1].grad is not None)

    def _create_states(self, parameters: Iterable[Tensor]) -> None:
        """Create the state of parameters that have none: no step, moments of 0."""
        gaussians = {p for group in self.param_groups if group.get("name") in PARAMETER_NAMES for p in group["params"]}
        for parameter in parameters:
            if not self.state[parameter]:
                trained = parameter[: self.trained_rows] if parameter in gaussians else parameter
                moments = (torch.zeros_like(trained, memory_format=torch.contiguous_format) for _ in range(2))
                self.state[parameter] = {"step": torch.zeros((), device=parameter.device)}
                self.state[parameter] |= zip(("exp_avg", "exp_avg_sq"), moments, strict=True)


def _first_rows(values: Tensor, moment: Tensor) -> Tensor:
    """Return the rows of a parameter or its gradient that have a moment."""
    return values if values.shape == moment.shape else values[: len(moment)]
