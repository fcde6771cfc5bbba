"""Reserved rows: memory for more Gaussians than there are, so that their number can change without reallocation.

A CUDA graph fixes the addresses and the row counts of its tensors. It therefore runs on all reserved rows; those beyond
the count are Gaussians of opacity 0, which no camera sees. Their moments and gradients are 0, so no step changes them.
"""

from typing import Any

import torch
from torch import Tensor, nn

INVISIBLE_LOGIT = -1e4
"""Opacity logit whose sigmoid is exactly 0 in float32."""


class ReservedRows:
    """Parameters and moments with reserved rows.

    Attributes:
        rows: Number of rows.
        all_rows: For each parameter name the parameter with all rows, [rows, ...].
        moments: For each parameter name the optimizer's tensors with all rows.
        active_count: [1] int32 on the device, the number of rows that are Gaussians.
    """

    def __init__(self, rows: int, device: torch.device):
        """Reserve `rows` rows on a device; store() fills them."""
        self.rows = rows
        self.all_rows: dict[str, nn.Parameter] = {}
        self.moments: dict[str, dict[str, Tensor]] = {}
        self.active_count = torch.zeros(1, dtype=torch.int32, device=device)

    def store(self, name: str, values: Tensor, moments: dict[str, Tensor]) -> None:
        """Copy a parameter [count, ...] and its moments into new memory with all rows."""
        self.all_rows[name] = nn.Parameter(self._with_reserved_rows(values))
        self.moments[name] = {key: self._with_reserved_rows(moment) for key, moment in moments.items()}
        self.clear(name, len(values), self.rows)

    def clear(self, name: str, first: int, last: int) -> None:
        """Set the rows [first, last) of a parameter to those of an invisible Gaussian, and their moments to 0."""
        values = self.all_rows[name].detach()[first:last]
        for each in (values, *(moment[first:last] for moment in self.moments[name].values())):
            each.zero_()
        if name == "opacity_logits":
            values.fill_(INVISIBLE_LOGIT)
        if name == "quaternions":
            values[:, 0] = 1

    def first(self, name: str, count: int) -> tuple[nn.Parameter, dict[str, Tensor]]:
        """Return the first `count` rows of a parameter as a parameter of its own, and of its moments."""
        return nn.Parameter(self.all_rows[name].detach()[:count]), first_rows(self.moments[name], count)

    def _with_reserved_rows(self, values: Tensor) -> Tensor:
        """Copy values into new memory with all rows."""
        all_rows = values.new_empty(self.rows, *values.shape[1:])
        all_rows[: len(values)] = values
        return all_rows


def first_rows(moments: dict[str, Tensor], count: int) -> dict[str, Tensor]:
    """Return the first `count` rows of each tensor."""
    return {key: moment[:count] for key, moment in moments.items()}


def moments_of(optimizer: Any, parameter: nn.Parameter) -> dict[str, Tensor]:
    """Return the optimizer's tensors with one row per Gaussian: all but Adam's step counter."""
    state = {} if optimizer is None else optimizer.state.get(parameter, {})
    return {key: value for key, value in state.items() if torch.is_tensor(value) and value.shape == parameter.shape}
