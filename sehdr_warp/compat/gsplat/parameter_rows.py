"""Change rows of parameters and of their optimizers' state together."""

from collections.abc import Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor

Parameters = MutableMapping[str, torch.nn.Parameter] | torch.nn.ParameterDict
Optimizers = Mapping[str, torch.optim.Optimizer]


def change_rows(
    params: Parameters,
    optimizers: Optimizers,
    statistics: MutableMapping[str, Any],
    keep: Tensor,
    appended: dict[str, Tensor] | None = None,
    sources: Tensor | None = None,
) -> None:
    """Replace each parameter by its kept rows and appended ones; optimizers know nothing of the latter yet.

    Args:
        params: by name, [N, ...] each.
        optimizers: by name, for those that are trained.
        statistics: values of which tensors with N rows follow.
        keep: [N] bool.
        appended: by name, rows behind the kept ones.
        sources: for each appended row the row whose statistics it takes over; 0 if None.
    """
    count = len(keep)
    for name in list(params):
        parameter = params[name]
        rows = parameter.detach()[keep]
        new = rows if appended is None else torch.cat([rows, appended[name].to(rows.dtype)])
        replacement = torch.nn.Parameter(new, requires_grad=parameter.requires_grad)
        optimizer = optimizers.get(name)
        if optimizer is not None:
            state = optimizer.state.pop(parameter, {})
            for key, value in state.items():
                if isinstance(value, Tensor) and value.shape == parameter.shape:
                    fresh = value.new_zeros(len(new) - len(rows), *value.shape[1:])
                    state[key] = torch.cat([value[keep], fresh])
            optimizer.state[replacement] = state
            optimizer.param_groups[0]["params"] = [replacement]
        params[name] = replacement
    for name, value in statistics.items():
        if isinstance(value, Tensor) and value.ndim and len(value) == count:
            more = 0 if appended is None else len(next(iter(appended.values())))
            rows = value[sources] if sources is not None else value.new_zeros(more, *value.shape[1:])
            statistics[name] = torch.cat([value[keep], rows])


def write_rows(
    params: Parameters, optimizers: Optimizers, values: dict[str, Tensor], rows: Tensor | None = None
) -> None:
    """Write values to parameters in place and set their optimizers' moments to 0, in `rows` or all of them."""
    for name, value in values.items():
        parameter = params[name]
        parameter.data.copy_(value)
        optimizer = optimizers.get(name)
        if optimizer is None:
            continue
        for moment in optimizer.state.get(parameter, {}).values():
            if isinstance(moment, Tensor) and moment.shape == parameter.shape:
                if rows is None:
                    moment.zero_()
                else:
                    moment[rows] = 0
