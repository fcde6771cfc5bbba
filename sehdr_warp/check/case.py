"""A case, what it measures, and how the bound of its error is derived.

Bounds come from Monte Carlo arithmetic (Parker 1997; earlier Vignes' CESTAC). The float64 truth is computed again with
every number at the interfaces of the stages disturbed at random by ROUNDINGS units of float32's rounding, forwards and
backwards. The change of the result is the error that float32 may cause in any order of operations. A kernel passes if
its error stays below it. The kernel's own result does not enter the bound.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

UNIT = 2.0**-24  # float32's unit of rounding
TINY = torch.finfo(torch.float32).tiny  # float32's smallest normal number
ROUNDINGS = 8
"""Units of rounding between two interfaces. project(), the longest chain, has about 40, which partly cancel."""
DRAWS = 4  # Random disturbances. The bound is twice their largest effect, plus ROUNDINGS units of the result itself.


@dataclass(frozen=True)
class Reading:
    """One measured quantity; error and bound are relative to the truth's norm unless the quantity names a unit."""

    quantity: str
    error: float
    bound: float

    @property
    def holds(self) -> bool:
        """Return whether the error stays within the bound; NaN does not."""
        return self.error <= self.bound


@dataclass(frozen=True)
class Case:
    """A stiff or extreme problem and how it is measured."""

    name: str  # For tables and for choosing it
    what: str  # One line
    measure: Callable[[torch.device], Iterable[Reading]]  # Takes a device, yields readings
    group: str = "splat"  # Splat, light, poison or training
    quick: bool = True  # Takes less than a second on two cores
    note: str = ""  # What float32 cannot do better here, and what is done about it


def _disturb(values: Tensor, generator: torch.Generator) -> Tensor:
    """Return x (1 + r), whose gradient is g (1 + r'), with r uniform within ROUNDINGS units."""

    def factor(of: Tensor) -> Tensor:
        noise = torch.rand(of.shape, generator=generator, dtype=torch.float64)
        return 1 + (2 * noise - 1) * (ROUNDINGS * UNIT)

    moved = values + values.detach() * (factor(values) - 1)
    if moved.requires_grad:
        moved.register_hook(lambda gradient: gradient * factor(gradient))
    return moved


def as_float32(tensors: Iterable[Tensor]) -> list[Tensor]:
    """Round to numbers that float32 holds exactly, as float64, so that both precisions get the same problem."""
    return [tensor.float().double() for tensor in tensors]


def _results(function: Callable, tensors: list[Tensor], gradients: dict[str, int]) -> dict[str, Tensor]:
    """Return the results of function(*tensors) by name, and gradients of their weighted sum as "d/d NAME".

    Args:
        function: takes the tensors, returns tensors by name.
        tensors: the arguments.
        gradients: names and places of the arguments to differentiate by. Weights are fixed, in [0.5, 1.5].

    Returns:
        float64 tensors on the CPU.
    """
    leaves = [t.detach().clone().requires_grad_(i in gradients.values()) for i, t in enumerate(tensors)]
    outputs = function(*leaves)
    if gradients:
        total = torch.zeros(())
        for seed, out in enumerate(outputs.values(), 7):
            weights = torch.rand(out.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            total = total + (out * (0.5 + weights).to(out)).sum()
        total.backward()
    for name, place in gradients.items():
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
    """Compare a function in float32 on the device with its truth in float64.

    Args:
        function: takes the tensors, returns results by name.
        tensors: float64 values by name.
        device: where float32 is computed.
        truth: takes `disturb` and the tensors, returns the same results; it passes what crosses a stage's border
            through disturb. By default the function itself, disturbed in its arguments alone.
        gradients: names of the tensors whose gradients are compared too.
        elementwise: measure the largest relative error of a number, rather than the relative error of the whole in
            norm.
        floor: numbers below it are compared absolutely, in units of it.
        extra: added to every bound, for errors that disturbed interfaces do not cover; the case says why.
        label: format of a quantity's name.

    Returns:
        A reading for each result and gradient.
    """

    def error(value: Tensor, exact: Tensor) -> float:
        if elementwise:
            return float(((value - exact).abs() / exact.abs().clamp_min(floor or TINY)).max())
        return float((value - exact).norm()) / (max(float(exact.norm()), floor) or 1.0)

    def run(draw: int) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(draw)
        disturb = partial(_disturb, generator=generator) if draw else lambda x: x
        return _results(lambda *t: by_stages(disturb, *map(disturb, t)), values, places)

    by_stages = truth or (lambda _, *t: function(*t))
    names, values = list(tensors), as_float32(tensors.values())
    places = {name: names.index(name) for name in gradients}
    ours = _results(function, [v.to(device, torch.float32) for v in values], places)
    exact, *disturbed = map(run, range(DRAWS + 1))
    readings = []
    for name, value in exact.items():
        bound = 2 * max(error(other[name], value) for other in disturbed) + ROUNDINGS * UNIT + extra
        readings.append(Reading(label.format(name), error(ours[name], value), bound))
    return readings


def count(quantity: str, wrong: int | Tensor) -> Reading:
    """Return a reading of a count that must be zero."""
    return Reading(quantity, float(wrong), 0.0)


def not_finite(*tensors: Tensor | None) -> int:
    """Return how many numbers are NaN or infinite; None counts as no numbers."""
    return sum(int((~torch.isfinite(t.detach())).sum()) for t in tensors if t is not None)
