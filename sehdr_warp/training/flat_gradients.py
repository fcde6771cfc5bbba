"""The buffer by which ranks exchange gradients: one all-reduce for all of them."""

import math

import torch
from torch import Tensor

from ..model.adam import FIRST_HARMONIC, Adam
from ..rasterizer import HarmonicsGradients
from .optimizer import named_parameters


class FlatGradients:
    """The gradients of all parameters of an optimizer in one buffer, which ranks exchange.

    Behind them are two numbers of the step: its loss, and whether there were more intersections than memory.
    """

    def __init__(self, optimizer: Adam, rank: int, count: int, *, defer_sh: bool):
        """Allocate the buffer of rank `rank` of `count`; if `defer_sh`, harmonics are exchanged in factored form."""
        self.all = dict(named_parameters(optimizer))
        factored = tuple(f"{name}." for name in FIRST_HARMONIC) if defer_sh else ()
        self.parameters = [parameter for name, parameter in self.all.items() if not name.startswith(factored)]
        self._means, self._rank, self._count = self.all["means.0."], rank, count
        shapes = [parameter.shape for parameter in self.parameters]
        shapes += [(count, *self._means.shape), (count, 3)] if defer_sh else []
        sizes = [math.prod(shape) for shape in shapes]
        self.buffer = torch.zeros(sum(sizes) + 2, device=self._means.device)
        *parts, self.numbers = self.buffer.split([*sizes, 2])
        self._views = [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
        self._with_gradient: list[int] = []
        self._degree: int | None = None

    def fits(self, optimizer: Adam) -> bool:
        """Return whether the optimizer still has the same parameters."""
        return all(self.all[name] is parameter for name, parameter in named_parameters(optimizer))

    @torch.no_grad()
    def collect(self, loss: Tensor, overflow: Tensor | None, harmonics: HarmonicsGradients | None = None) -> None:
        """Move the parameters' gradients to the buffer, with the numbers of the step.

        All ranks must have gradients of the same parameters, which may differ from step to step.
        """
        gradients = {k: value.grad for k, value in enumerate(self.parameters) if value.grad is not None}
        self._with_gradient = [*gradients]
        torch._foreach_copy_([self._views[k] for k in gradients], [*gradients.values()])
        self._degree = None
        if harmonics is not None:
            # The slots of other ranks are zero, so that the sum over the ranks gathers all.
            grad_colors, positions = (part.zero_() for part in self._views[-2:])
            grad_colors[self._rank], positions[self._rank] = harmonics.grad_colors[0], harmonics.positions[0]
            self._degree = harmonics.degree
        self.numbers[0] = loss.detach()
        self.numbers[1] = torch.zeros_like(loss) if overflow is None else overflow.to(loss.dtype)
        for k in self._with_gradient:
            self.parameters[k].grad = None

    def distribute(self) -> tuple[Tensor, Tensor, HarmonicsGradients | None]:
        """Set the parameters' gradients to the buffer, after it was averaged over the ranks.

        Returns:
            Loss, whether a rank had more intersections than memory ([] bool), and factored gradients of the harmonics.
        """
        for k in self._with_gradient:
            self.parameters[k].grad = self._views[k]
        harmonics = None
        if self._degree is not None:
            grad_colors, positions = self._views[-2:]
            # Positions are no mean: each is in one rank's slot, and all_reduce_mean() has divided it by the count.
            harmonics = HarmonicsGradients(grad_colors, positions * self._count, self._means, self._degree)
        return self.numbers[0], self.numbers[1] > 0, harmonics
