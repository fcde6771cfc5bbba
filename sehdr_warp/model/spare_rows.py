"""Memory for more Gaussians than there are, so that their number changes while they stay where they are.

A recorded step holds fixed where tensors are and how many rows they have. It therefore works on all rows; those beyond
the count are Gaussians that no camera sees, of opacity 0, whose moments and gradients are 0, so that no step changes
them.
"""

from typing import Any

import torch
from torch import Tensor, nn

UNSEEN = -1e4
"""The logit of an opacity of exactly 0."""


class SpareRows:
    """rows: how many there are. whole, moments: by name of the parameter all rows of it, [rows, ...], and of what an
    optimizer keeps beside it. live: [1] int32 on the device, how many of them are Gaussians."""

    def __init__(self, rows: int, device: torch.device):
        self.rows = rows
        self.whole: dict[str, nn.Parameter] = {}
        self.moments: dict[str, dict[str, Tensor]] = {}
        self.live = torch.zeros(1, dtype=torch.int32, device=device)

    def take(self, name: str, values: Tensor, moments: dict[str, Tensor]) -> None:
        """Makes room for a parameter that is `values` [count, ...] now, and copies them."""
        self.whole[name] = nn.Parameter(self._copied(values))
        self.moments[name] = {key: self._copied(moment) for key, moment in moments.items()}
        self.clear(name, len(values), self.rows)

    def clear(self, name: str, first: int, last: int) -> None:
        """Makes the rows [first, last) of a parameter those of Gaussians that no camera sees."""
        values = self.whole[name].detach()[first:last]
        for each in (values, *(moment[first:last] for moment in self.moments[name].values())):
            each.zero_()
        if name == "opacity_logits":
            values.fill_(UNSEEN)
        if name == "quaternions":
            values[:, 0] = 1

    def first(self, name: str, count: int) -> tuple[nn.Parameter, dict[str, Tensor]]:
        """The first rows of a parameter, as a parameter of their own, and of its moments."""
        return nn.Parameter(self.whole[name].detach()[:count]), first_rows(self.moments[name], count)

    def _copied(self, values: Tensor) -> Tensor:
        whole = values.new_empty(self.rows, *values.shape[1:])
        whole[: len(values)] = values
        return whole


def first_rows(moments: dict[str, Tensor], count: int) -> dict[str, Tensor]:
    """The first rows of each."""
    return {key: moment[:count] for key, moment in moments.items()}


def moments_of(optimizer: Any, parameter: nn.Parameter) -> dict[str, Tensor]:
    """The optimizer's tensors that have one row a Gaussian: all but Adam's step counter."""
    state = {} if optimizer is None else optimizer.state.get(parameter, {})
    return {key: value for key, value in state.items() if torch.is_tensor(value) and value.shape == parameter.shape}
