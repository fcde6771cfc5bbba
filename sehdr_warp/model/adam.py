"""Adam without torch.optim, whose making loads torch's compiler: two seconds of every start."""

from collections import defaultdict
from collections.abc import Iterable

import torch
from torch import Tensor

from ..rasterizer import HarmonicsGradients
from ..rasterizer.training_step import AdamStep, adam_steps, harmonics_adam_step
from .gaussians import PARAMETER_NAMES

FIRST_COEFFICIENT = {"harmonics_dc": 0, "harmonics_rest": 1}
"""Of the groups that hold coefficients of harmonics."""
BETAS = 0.9, 0.999
EPSILON = 1e-15  # 3DGS: gradients of a single Gaussian are tiny, and must not drown in Adam's usual 1e-8


class Adam:
    """Steps of rasterizer.training_step; groups, of `params` and `lr`, and state are laid out as torch.optim.Adam's.

    turns: parts of the harmonics above degree 0 that step in turn, where their gradients come as factors.
    """

    def __init__(self, groups: list[dict], betas: tuple[float, float] = BETAS, turns: int = 1):
        self.turns = turns
        self.param_groups = [{"betas": betas, "eps": EPSILON} | group for group in groups]
        self.state: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict)

    def zero_grad(self) -> None:
        """Forgets the gradients of all parameters."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def moments(self, parameters: Iterable[Tensor]) -> list[Tensor]:
        """First and second of those parameters that had a step."""
        kept = (self.state[parameter] for parameter in parameters if parameter in self.state)
        return [state[key] for state in kept for key in ("exp_avg", "exp_avg_sq")]

    @torch.no_grad()
    def step(
        self,
        skipped: Tensor | None = None,
        made: Tensor | None = None,
        harmonics: HarmonicsGradients | None = None,
        live: Tensor | None = None,
    ) -> None:
        """skipped: scalar, 1 where parameters, moments and step count stay as they are. made: 1 - skipped. harmonics:
        the gradients of coefficients that have none of their own. live: [1] int32, how many Gaussians count, where the
        rows of their parameters are more, with gradients of 0."""
        factored = FIRST_COEFFICIENT if harmonics is not None else ()
        grouped = [
            (group, parameter)
            for group in self.param_groups
            for parameter in group["params"]
            if parameter.grad is not None or group.get("name") in factored
        ]
        # Directions to centres are those of before the step.
        grouped.sort(key=lambda pair: pair[1].grad is not None)
        parameters = [parameter for _, parameter in grouped]
        skipped = parameters[0].new_zeros(()) if skipped is None else skipped
        made = 1 - skipped if made is None else made
        for parameter in parameters:
            if not self.state[parameter]:
                moments = (torch.zeros_like(parameter, memory_format=torch.contiguous_format) for _ in range(2))
                self.state[parameter] = {"step": torch.zeros((), device=parameter.device)}
                self.state[parameter] |= zip(("exp_avg", "exp_avg_sq"), moments, strict=True)
        # With lists on both sides: to add one tensor to many, torch reads it on the host, which no recording allows.
        steps = [self.state[p]["step"] for p in parameters]
        torch._foreach_add_(steps, [made] * len(steps))  # pyright: ignore[reportPrivateImportUsage]
        own, options = [], {}  # All groups have the same options.
        for group, parameter in grouped:
            first, second, step = (self.state[parameter][key] for key in ("exp_avg", "exp_avg_sq", "step"))
            options, values = {"betas": group["betas"], "epsilon": group["eps"]}, parameter.detach()
            if parameter.grad is not None:
                width = values.numel() // len(values) if group.get("name") in PARAMETER_NAMES else 0
                own.append(AdamStep(values, parameter.grad.contiguous(), first, second, step, group["lr"], width))
            elif harmonics is not None:
                state, rate = (first, second, step, skipped), {"rate": group["lr"]}
                start = FIRST_COEFFICIENT[group["name"]]
                turns = self.turns if start else 1
                harmonics_adam_step(values, start, harmonics, *state, **rate, **options, live=live, turns=turns)
        adam_steps(own, skipped, **options, live=live)
