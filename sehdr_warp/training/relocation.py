"""Densification as a Markov chain: 3D Gaussian Splatting as Markov Chain Monte Carlo (NeurIPS 2024).

Dead Gaussians move to where living ones are, in a way that keeps the image; the count grows by a fixed part up to the
budget; noise on the positions of the faint ones explores. No opacity resets, no gradient statistics.
"""

import math

import torch
from torch import Tensor

from ..field.gaussians import Gaussians
from ..splatting.training_step import add_position_noise
from .config import Config, DensificationConfig
from .densification import Densification

MOST_COPIES = 51
"""A Gaussian is shared by at most this many at once, as in the authors' code: the binomial sums stay exact."""
MOST_GROWTH = 1.0
"""A change adds at most as many as there are: each then shares with one other in the mean."""
SEED_STEP = 1_000_003
"""Seeds of trainings are this far apart in the seeds of their noise, one for each iteration."""


class Relocation(Densification):
    """Relocation, growth and noise; see the module. pixels: of all training photos, for the budget.

    most: the budget. A start with more Gaussians keeps its count: they move, and none are added.
    """

    def __init__(self, config: Config, extent: float, pixels: int):
        super().__init__(config, extent)
        self.most = gaussian_budget(self.options, pixels)
        self._sums = _relocation_sums()

    @torch.no_grad()
    def change(self, iteration: int, gaussians: Gaussians, optimizer: torch.optim.Optimizer, generator) -> bool:
        if not self._is_due(iteration):
            return False
        dead = gaussians.opacities() <= self.options.prune_opacity
        self._relocate(gaussians, dead, optimizer, generator)
        count = gaussians.count
        target = self.next_count(iteration, count)
        if target > count:
            self._add(gaussians, target - count, optimizer, generator)
        return target > count

    def next_count(self, iteration: int, count: int) -> int:
        """How many Gaussians there are after the change at an iteration: more by `growth`, or by as much as takes the
        count to the budget by the last change, at most MOST_GROWTH."""
        growth = self.options.growth
        if growth and count < self.most:
            left = (self.stop - 1) // self.every - iteration // self.every + 1
            growth = max(growth, min((self.most / count) ** (1 / left) - 1, MOST_GROWTH))
        return max(count, min(self.most, math.ceil((1 + growth) * count)))

    def perturb(self, iteration: int, gaussians: Gaussians, means_rate: float) -> None:
        if self.options.noise == 0:
            return
        add_position_noise(
            gaussians.means,
            gaussians.log_scales,
            gaussians.quaternions,
            gaussians.opacity_logits,
            strength=self.options.noise * means_rate,
            # Of the iteration and not of a running generator, so that a resumed training draws what it would have.
            seed=(self.config.seed * SEED_STEP + iteration) % 2**31,
        )

    def _relocate(self, gaussians: Gaussians, dead: Tensor, optimizer, generator) -> None:
        """Moves the dead, in place."""
        dead_index, alive = dead.nonzero()[:, 0], (~dead).nonzero()[:, 0]
        if len(dead_index) == 0 or len(alive) == 0:
            return
        chosen = alive[_draw(gaussians.opacities()[alive], len(dead_index), generator)]
        self._share(gaussians, chosen, optimizer)
        # In the authors' code the moved ones keep their Adam state, and only those that share lose it.
        with torch.no_grad():
            for name, values in gaussians.rows(chosen).items():
                getattr(gaussians, name)[dead_index] = values

    def _add(self, gaussians: Gaussians, count: int, optimizer, generator) -> None:
        chosen = _draw(gaussians.opacities(), count, generator)
        self._share(gaussians, chosen, optimizer)
        gaussians.append(gaussians.rows(chosen), optimizer)

    def _share(self, gaussians: Gaussians, chosen: Tensor, optimizer) -> None:
        """Makes each chosen Gaussian the n-th part of itself, n = 1 + how often it was chosen (equation 9)."""
        copies = torch.bincount(chosen, minlength=gaussians.count)
        index = copies.nonzero()[:, 0]
        parts = (copies[index] + 1).clamp_max(MOST_COPIES)
        opacity = gaussians.opacities()[index].clamp_max(1 - 1e-6)
        part = 1 - (1 - opacity) ** (1 / parts)
        powers = part[:, None].double() ** torch.arange(1, MOST_COPIES + 1, device=part.device)
        total = (self._sums.to(part.device)[parts - 1] * powers).sum(1)
        shrink = (opacity.double() / total).clamp(1e-3, 1.0).float()
        part = part.clamp(self.options.prune_opacity, 1 - 1e-6)
        gaussians.overwrite(
            {
                "opacity_logits": torch.logit(part),
                "log_scales": gaussians.log_scales[index] + shrink.log()[:, None],
            },
            index,
            optimizer,
        )
        for name in ("means", "quaternions", "harmonics_dc", "harmonics_rest"):
            gaussians.forget(name, index, optimizer)


def gaussian_budget(options: DensificationConfig, pixels: int) -> int:
    """The most Gaussians that relocation makes for training photos of so many pixels in all."""
    if not options.budget:
        return options.max_gaussians
    return min(options.max_gaussians, int(options.budget * math.sqrt(pixels)))


def _draw(weights: Tensor, count: int, generator) -> Tensor:
    """[count] indices drawn in proportion to weights, with replacement; by bisection, for any number of weights."""
    steps = weights.double().cumsum(0)
    uniform = torch.rand(count, generator=generator, device=weights.device, dtype=torch.float64)
    return torch.searchsorted(steps, uniform * steps[-1]).clamp_max(len(weights) - 1)


def _relocation_sums() -> Tensor:
    """[MOST_COPIES, MOST_COPIES] float64; row n - 1 dotted with (o, o^2, ...) is the denominator of equation 9 for n:
    sum over i <= n and k < i of binomial(i - 1, k) (-1)^k o^(k + 1) / sqrt(k + 1)."""
    rows = torch.zeros(MOST_COPIES, MOST_COPIES, dtype=torch.float64)
    for n in range(1, MOST_COPIES + 1):
        for k in range(n):
            # The binomials of a column sum to one binomial (hockey stick).
            rows[n - 1, k] = math.comb(n, k + 1) * (-1) ** k / math.sqrt(k + 1)
    return rows
