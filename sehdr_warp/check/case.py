"""A case of the catalogue, what it measures, and how an error bound is derived.

Bounds come from Monte Carlo arithmetic (Parker 1997; Vignes' CESTAC before): the float64 truth is computed again with
every number at the interfaces of the stages disturbed at random by ROUNDINGS units of float32's rounding, forwards and
backwards. How far that moves the result is what float32 may cost here, whatever the order of the operations; a kernel
passes if its error stays within it. Nothing of the kernel's own result enters its bound.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

UNIT = 2.0**-24
TINY = torch.finfo(torch.float32).tiny
"""float32's unit of rounding, and its smallest normal number."""
ROUNDINGS = 8  # Between two interfaces: project(), the longest chain, has about 40 in a row, which partly cancel
DRAWS = 4  # The bound is twice the largest effect of so many disturbances, plus ROUNDINGS units of the result itself


@dataclass(frozen=True)
class Reading:
    """One measured quantity. error and bound in one unit, relative to the truth's norm where not said otherwise."""

    quantity: str
    error: float
    bound: float

    @property
    def holds(self) -> bool:
        return self.error <= self.bound  # as NaN is not


@dataclass(frozen=True)
class Case:
    """A stiff or extreme problem and how it is measured.

    Attributes:
        name: for tables and for choosing it.
        what: one line.
        measure: takes a device, yields readings.
        group: splat, light, poison or training.
        quick: takes less than a second on two cores.
        note: what float32 cannot do better here, and what is done about it.
    """

    name: str
    what: str
    measure: Callable[[torch.device], Iterable[Reading]]
    group: str = "splat"
    quick: bool = True
    note: str = ""


def _disturbed(values: Tensor, generator: torch.Generator) -> Tensor:
    """x (1 + r) forwards and g (1 + r') backwards, r uniform within ROUNDINGS units."""

    def factor(of: Tensor) -> Tensor:
        noise = torch.rand(of.shape, generator=generator, dtype=torch.float64)
        return 1 + (2 * noise - 1) * (ROUNDINGS * UNIT)

    moved = values + values.detach() * (factor(values) - 1)
    if moved.requires_grad:
        moved.register_hook(lambda gradient: gradient * factor(gradient))
    return moved


def as_float32(tensors: Iterable[Tensor]) -> list[Tensor]:
    """float64 tensors of numbers that float32 holds exactly: both precisions then get the same problem."""
    return [tensor.float().double() for tensor in tensors]


def _results(function, tensors: list[Tensor], wanted: dict[str, int]) -> dict[str, Tensor]:
    """The results of function(*tensors) by name, then the gradients by the wanted tensors (by name, with their place)
    of the results' sum with fixed weights in [0.5, 1.5]; all float64 on the CPU."""
    leaves = [t.detach().clone().requires_grad_(i in wanted.values()) for i, t in enumerate(tensors)]
    outputs = function(*leaves)
    if wanted:
        total = torch.zeros(())
        for seed, out in enumerate(outputs.values(), 7):
            weights = torch.rand(out.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            total = total + (out * (0.5 + weights).to(out)).sum()
        total.backward()
    for name, place in wanted.items():
        gradient = leaves[place].grad
        outputs = outputs | {f"d/d {name}": torch.zeros_like(leaves[place]) if gradient is None else gradient}
    return {name: value.detach().double().cpu() for name, value in outputs.items()}


def compare(
    function,
    tensors: dict[str, Tensor],
    device: torch.device,
    *,
    truth=None,
    gradients: Sequence[str] = (),
    elementwise: bool = False,
    floor: float = 0.0,
    extra: float = 0.0,
    label: str = "{}",
) -> list[Reading]:
    """Readings of function in float32 on the device against truth in float64.

    function(*tensors) -> dict of results by name. tensors: float64 values by name. gradients: names by which the
    derivative is compared too. truth(disturb, *tensors) -> the same, which passes what crosses a stage's border through
    disturb; by default the function itself, disturbed in its arguments alone. elementwise: the largest relative error
    of any number, rather than the relative error of the whole in norm. floor: numbers below it are compared absolutely,
    in units of it. extra: added to every bound, for what the kernel's arithmetic costs beside disturbed interfaces; the
    case says why. label: what becomes of a quantity's name.
    """

    def error(value: Tensor, exact: Tensor) -> float:
        if elementwise:
            return float(((value - exact).abs() / exact.abs().clamp_min(floor or TINY)).max())
        return float((value - exact).norm()) / (max(float(exact.norm()), floor) or 1.0)

    def run(draw: int) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(draw)
        disturb = partial(_disturbed, generator=generator) if draw else lambda x: x
        return _results(lambda *t: by_stages(disturb, *map(disturb, t)), values, wanted)

    by_stages = truth or (lambda _, *t: function(*t))
    names, values = list(tensors), as_float32(tensors.values())
    wanted = {name: names.index(name) for name in gradients}
    ours = _results(function, [v.to(device, torch.float32) for v in values], wanted)
    exact, *disturbed = map(run, range(DRAWS + 1))
    readings = []
    for name, value in exact.items():
        bound = 2 * max(error(other[name], value) for other in disturbed) + ROUNDINGS * UNIT + extra
        readings.append(Reading(label.format(name), error(ours[name], value), bound))
    return readings


def count(quantity: str, wrong: int | Tensor) -> Reading:
    """A reading that counts what must not be."""
    return Reading(quantity, float(wrong), 0.0)


def not_finite(*tensors: Tensor | None) -> int:
    """How many numbers of the tensors that there are are NaN or infinite."""
    return sum(int((~torch.isfinite(t.detach())).sum()) for t in tensors if t is not None)
