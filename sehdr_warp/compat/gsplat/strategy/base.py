"""The interface of gsplat's strategies.

They take parameters "means", "scales" (logarithms), "quats", "opacities" (logits) and any others by name, [N, ...]
each, with one optimizer for each that is trained.
"""

from dataclasses import dataclass
from typing import Any

from ..parameter_rows import Optimizers, Parameters

State = dict[str, Any]
REQUIRED = "means", "scales", "quats", "opacities"


@dataclass
class Strategy:
    """Interface of strategies. Subclasses may override the steps of one, which have gsplat's names and arguments."""

    def check_sanity(self, params: Parameters, optimizers: Optimizers) -> None:
        """Raise ValueError unless there is one optimizer with one group for each trainable parameter."""
        trainable = {name for name, value in params.items() if value.requires_grad}
        if trainable != set(optimizers):
            raise ValueError(f"there are parameters {sorted(trainable)}, but optimizers {sorted(optimizers)}")
        for name, optimizer in optimizers.items():
            if len(optimizer.param_groups) != 1:
                raise ValueError(f"the optimizer of {name} has {len(optimizer.param_groups)} groups, expected 1")
        if missing := set(REQUIRED) - set(params):
            raise ValueError(f"there is no parameter {', '.join(sorted(missing))}")

    def step_pre_backward(self, *args: Any, **kwargs: Any) -> None:
        """Prepare what the backward pass has to keep."""

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """Change the Gaussians after the backward pass."""
