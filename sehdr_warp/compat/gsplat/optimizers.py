"""gsplat's SelectiveAdam."""

from typing import Any

import torch
from torch import Tensor


class SelectiveAdam(torch.optim.Adam):
    """Adam for the visible Gaussians alone (Taming 3DGS, Mallick et al. 2024), without correction of its bias.

    Each group has one parameter [N, ...].
    """

    def __init__(self, params: Any, eps: float, betas: tuple[float, float]) -> None:
        """Take gsplat's arguments; learning rates are those of the groups."""
        super().__init__(params, eps=eps, betas=betas)

    @torch.no_grad()
    def step(self, visibility: Tensor) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Change the rows that visibility [N] marks, and their moments; the others stay."""
        if not isinstance(visibility, Tensor):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError(f"visibility is a {type(visibility).__name__}, expected a tensor [N]")
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise ValueError(f"a group has {len(group['params'])} parameters, expected 1")
            (parameter,), (beta1, beta2) = group["params"], group["betas"]
            if parameter.grad is None:
                continue
            if visibility.numel() != len(parameter):
                raise ValueError(
                    f"visibility has shape {list(visibility.shape)}, but a parameter {list(parameter.shape)}"
                )
            state = self.state[parameter]
            if not state:
                state["step"] = torch.tensor(0.0)
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
            mask = visibility.bool().view(-1, *[1] * (parameter.ndim - 1))
            first = state["exp_avg"].lerp(parameter.grad, 1 - beta1)
            second = state["exp_avg_sq"].lerp(parameter.grad.square(), 1 - beta2)
            values = parameter - group["lr"] * first / (second.sqrt() + group["eps"])
            for old, new in ((state["exp_avg"], first), (state["exp_avg_sq"], second), (parameter, values)):
                old.copy_(torch.where(mask, new, old))
