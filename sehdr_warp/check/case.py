"""A case of the catalogue, what it measures, and how an error bound is derived.

Bounds come from Monte Carlo arithmetic (Parker 1997; Vignes' CESTAC before): the float64 truth is computed again with
every number at the interfaces of the stages disturbed at random by ROUNDINGS units of float32's rounding, forwards and
backwards. How far that moves the result is what float32 may cost here, whatever the order of the operations; a kernel
passes if its error stays within it. Nothing of the kernel's own result enters its bound.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

UNIT = 2.0**-24
"""float32's unit of rounding."""
ROUNDINGS = 8
"""Roundings allowed between two interfaces: the longest chain of operations there, project(), has about 40 in a row,
whose errors partly cancel."""
DRAWS = 4
"""Random disturbances; the bound is twice the largest effect among them, plus ROUNDINGS units of the result itself."""


@dataclass(frozen=True)
class Reading:
    """One measured quantity. error and bound in the same unit, relative to the truth's norm where not said otherwise;
    an error that is not finite fails."""

    quantity: str
    error: float
    bound: float

    @property
    def holds(self) -> bool:
        return self.error <= self.bound


@dataclass(frozen=True)
class Case:
    """name: for --cases. what: one line. measure: device -> readings. quick: part of --quick and of the tests. note:
    what float32 cannot do better here, and what is done about it."""

    name: str
    what: str
    measure: Callable[[torch.device], list[Reading]]
    quick: bool = True
    note: str = ""


class _Disturb(torch.autograd.Function):
    """x (1 + r) forwards and g (1 + r') backwards, r uniform within ROUNDINGS units."""

    @staticmethod
    def forward(ctx, x, generator):
        ctx.generator = generator
        return x * _factors(x, generator)

    @staticmethod
    def backward(ctx, gradient):
        return gradient * _factors(gradient, ctx.generator), None


def _factors(x: Tensor, generator: torch.Generator) -> Tensor:
    noise = torch.rand(x.shape, generator=generator, dtype=torch.float64)
    return 1 + (2 * noise - 1) * (ROUNDINGS * UNIT)


def _disturbance(draw: int) -> Callable[[Tensor], Tensor]:
    """Disturbs tensors with new random numbers at each call; draw 0 leaves them as they are."""
    generator = torch.Generator().manual_seed(draw)
    return (lambda x: _Disturb.apply(x, generator)) if draw else lambda x: x


def as_float32(tensors: list[Tensor]) -> list[Tensor]:
    """float64 tensors of numbers that float32 holds exactly: both precisions then get the same problem."""
    return [tensor.float().double() for tensor in tensors]


def _upstream(tensor: Tensor, seed: int) -> Tensor:
    """Fixed weights in [0.5, 1.5] for a result, so that a scalar's gradient sees each of its numbers."""
    return 0.5 + torch.rand(tensor.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _measured(function, tensors: list[Tensor], wanted: list[int]) -> dict[str, Tensor]:
    """The results of function(*tensors) by name, then the gradients of their weighted sum by the wanted tensors, by
    their number; all float64 on the CPU."""
    leaves = [t.detach().clone().requires_grad_(i in wanted) for i, t in enumerate(tensors)]
    outputs = function(*leaves)
    if wanted:
        sum((out * _upstream(out, 7 + i).to(out)).sum() for i, out in enumerate(outputs.values())).backward()
    gradients = {f"{i}": torch.zeros_like(leaves[i]) if leaves[i].grad is None else leaves[i].grad for i in wanted}
    return {name: value.detach().double().cpu() for name, value in (outputs | gradients).items()}


def compare(
    function,
    truth,
    tensors: dict[str, Tensor],
    device: torch.device,
    *,
    gradients: tuple[str, ...] = (),
    elementwise: bool = False,
    floor: float = 0.0,
    extra: float = 0.0,
    label: str = "{}",
) -> list[Reading]:
    """Readings of function in float32 on the device against truth in float64.

    Args:
        function: function(*tensors) -> dict of results by name.
        truth: truth(disturb, *tensors) -> the same, which passes what crosses a stage's border through disturb.
        tensors: float64 values by name. gradients: names by which the derivative is compared too.
        elementwise: the largest relative error of any number, rather than the relative error of the whole in norm.
        floor: numbers below it are compared absolutely, in units of it.
        extra: added to every bound, for what the kernel's arithmetic costs beside disturbed interfaces; the case says
            why. label: what becomes of a quantity's name.
    """
    names, values = list(tensors), as_float32(list(tensors.values()))
    wanted = [names.index(name) for name in gradients]
    ours = _measured(function, [v.to(device, torch.float32) for v in values], wanted)
    runs = []
    for draw in range(DRAWS + 1):
        disturb = _disturbance(draw)
        runs.append(_measured(lambda *t, d=disturb: truth(d, *map(d, t)), values, wanted))
    measure = _elementwise if elementwise else _in_norm
    readings = []
    for key, exact in runs[0].items():
        effect = max(measure(run[key], exact, floor) for run in runs[1:])
        quantity = f"d/d {names[int(key)]}" if key.isdecimal() else key
        error, bound = measure(ours[key], exact, floor), 2 * effect + ROUNDINGS * UNIT + extra
        readings.append(Reading(label.format(quantity), error, bound))
    return readings


def compare_alike(function, tensors: dict[str, Tensor], device: torch.device, **options) -> list[Reading]:
    """compare() of a function whose float64 truth is itself, disturbed in its arguments alone."""
    return compare(function, lambda _, *t: function(*t), tensors, device, **options)


def _in_norm(value: Tensor, exact: Tensor, floor: float) -> float:
    size = max(float(exact.norm()), floor)
    return float((value - exact).norm()) / size if size > 0 else float(value.norm())


def _elementwise(value: Tensor, exact: Tensor, floor: float) -> float:
    size = exact.abs().clamp_min(floor or torch.finfo(torch.float32).tiny)
    return float(((value - exact).abs() / size).max())


def count(quantity: str, wrong: int | Tensor) -> Reading:
    """A reading that counts what must not be."""
    return Reading(quantity, float(wrong), 0.0)


def not_finite(*tensors: Tensor) -> int:
    """How many numbers of the tensors are NaN or infinite."""
    return sum(int((~torch.isfinite(t.detach())).sum()) for t in tensors)
