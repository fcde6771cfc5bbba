"""How the number of Gaussians changes during training.

GradientDensification is adaptive density control (3DGS, section 5.2, with the constants of its code); Relocation is 3D
Gaussian Splatting as Markov Chain Monte Carlo (NeurIPS 2024). Both change the Gaussians only through Gaussians.keep /
append / overwrite, which carry Adam's state.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ..field.gaussians import PARAMETER_NAMES, Gaussians
from ..splatting import Rendering
from ..splatting.training_step import add_gradient_statistics, add_position_noise
from .config import Config, DensificationConfig

SPLIT_SHRINK = 1.6  # The two halves of a split are this much smaller (3DGS: 0.8 times the number of halves)
SHORTEST_INTERVAL = 20
"""Iterations between changes are never fewer, however short the training: gradients need photos to be means of."""
SHORTEST_RESET = 300
"""Where resets would come closer together they are left out: opacities would not recover in between."""
MOST_COPIES = 51
"""A Gaussian is shared by at most this many at once, as in the authors' code: the binomial sums stay exact."""
MOST_GROWTH = 1.0  # A change adds at most as many as there are: each then shares with one other in the mean
SEED_STEP = 1_000_003  # Seeds of trainings are this far apart in the seeds of their noise, one for each iteration


Births = Callable[[int], dict[str, Tensor]]
"""Rows of at most so many new Gaussians, where the photos are explained worst."""


class Densification:
    """What the trainer asks of a strategy; by itself it changes nothing.

    extent: of the scene, world units. pixels: of all training photos. most: the count that no change exceeds.
    """

    def __init__(self, config: Config, extent: float, pixels: int):
        self.config, self.options, self.extent = config, config.densification, extent
        self.most = self.options.max_gaussians
        self.start, self.stop, self.every, self.reset_every = (
            config.scaled(getattr(self.options, name)) for name in ("start", "stop", "every", "reset_every")
        )
        self.every = max(self.every, SHORTEST_INTERVAL)
        self.photos = 1
        """Iterations that the step makes at once: where several ranks train, each takes a photo."""

    def needs_gradients(self, iteration: int) -> bool:
        """Whether observe() wants the gradients of the projected means at this iteration."""
        return False

    def prepare(self, count: int, device: torch.device | str) -> None:
        """Makes room for what observe() adds to."""

    def observe(self, rendering: Rendering, width: int, height: int, usable: Tensor) -> None:
        """Takes note of a step's image gradients. usable: scalar tensor, 0 where the step is to be ignored."""

    def changes_at(self, iteration: int) -> bool:
        """Whether change() does anything at this iteration."""
        return self._is_due(iteration)

    def change(self, iteration: int, gaussians: Gaussians, optimizer, generator, births: Births | None = None) -> bool:
        """Changes the Gaussians where this iteration is one for it; True if any tensor was replaced by another."""
        return False

    def perturb(self, iteration: int, gaussians: Gaussians, means_rate: float) -> None:
        """What happens to the positions after each step of the optimizer."""

    def state(self) -> dict[str, Tensor]:
        """Running statistics, for a checkpoint."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Takes up the statistics of state()."""

    def _is_due(self, iteration: int) -> bool:
        past = iteration % self.every
        return past < self.photos and self.start < iteration - past < self.stop


class GradientDensification(Densification):
    """Clones small and splits large Gaussians where the image pulls at them, prunes the faint and the huge, and
    resets opacities now and then so that only what is needed grows back."""

    gradient_sum: Tensor | None = None
    seen: Tensor | None = None

    def needs_gradients(self, iteration: int) -> bool:
        return iteration < self.stop

    def prepare(self, count: int, device: torch.device | str) -> None:
        if self.gradient_sum is None:
            self.gradient_sum, self.seen = torch.zeros(count, device=device), torch.zeros(count, device=device)

    @torch.no_grad()
    def observe(self, rendering: Rendering, width: int, height: int, usable: Tensor) -> None:
        gradients, total, seen = rendering.means2d.grad, self.gradient_sum, self.seen
        assert gradients is not None and total is not None and seen is not None
        add_gradient_statistics(gradients, rendering.radii, usable, width, height, total, seen)

    @torch.no_grad()
    def change(self, iteration: int, gaussians: Gaussians, optimizer, generator, births: Births | None = None) -> bool:
        total, seen = self.gradient_sum, self.seen
        changed = False
        if self._is_due(iteration) and total is not None and seen is not None:
            changed = True
            self._grow(gaussians, total / seen.clamp_min(1), optimizer, generator)
            self._prune(gaussians, optimizer, oversized=iteration > self.reset_every)
            self.gradient_sum = self.seen = None
        if self._resets(iteration):
            opacity = 2 * self.options.prune_opacity
            logits = gaussians.opacity_logits.clamp_max(math.log(opacity / (1 - opacity)))
            gaussians.overwrite({"opacity_logits": logits}, optimizer=optimizer)
        return changed

    def changes_at(self, iteration: int) -> bool:
        return self._is_due(iteration) or self._resets(iteration)

    def _resets(self, iteration: int) -> bool:
        past = iteration % self.reset_every
        return past < self.photos and iteration - past < self.stop and self.reset_every >= SHORTEST_RESET

    def _grow(self, gaussians: Gaussians, gradient: Tensor, optimizer, generator) -> None:
        wanted = gradient > self.options.grow_gradient
        room = self.most - gaussians.count
        if int(wanted.sum()) > room:
            if room <= 0:
                return
            # Short of room, those that the image pulls at hardest go first.
            wanted = torch.zeros_like(wanted).index_fill_(0, gradient.topk(room).indices, True) & wanted
        small = gaussians.log_scales.amax(1) <= math.log(self.options.grow_scale * self.extent)
        clones, parents = (wanted & small).nonzero()[:, 0], (wanted & ~small).nonzero()[:, 0]
        if len(clones) + len(parents) == 0:
            return
        added = [gaussians.rows(clones), *(self._half(gaussians, parents, generator) for _ in range(2))]
        if len(parents):
            gaussians.keep(torch.ones_like(wanted).index_fill_(0, parents, False), optimizer)
        gaussians.append({name: torch.cat([rows[name] for rows in added]) for name in PARAMETER_NAMES}, optimizer)

    def _half(self, gaussians: Gaussians, parents: Tensor, generator) -> dict[str, Tensor]:
        """One smaller Gaussian for each parent, at a point drawn from it."""
        rows = gaussians.rows(parents)
        normal = torch.randn(len(parents), 3, generator=generator, device=parents.device)
        rows["means"] += rotate(rows["quaternions"], normal * rows["log_scales"].exp())
        rows["log_scales"] -= math.log(SPLIT_SHRINK)
        return rows

    def _prune(self, gaussians: Gaussians, optimizer, oversized: bool) -> None:
        unwanted = gaussians.opacities() < self.options.prune_opacity
        if oversized:
            unwanted |= gaussians.log_scales.amax(1) > math.log(self.options.prune_scale * self.extent)
        if 0 < int(unwanted.sum()) < gaussians.count:
            gaussians.keep(~unwanted, optimizer)

    def state(self) -> dict[str, Tensor]:
        given = {"gradient_sum": self.gradient_sum, "seen": self.seen}
        return {name: values for name, values in given.items() if values is not None}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.gradient_sum, self.seen = state.get("gradient_sum"), state.get("seen")


class Relocation(Densification):
    """Dead Gaussians move to where living ones are, in a way that keeps the image; the count grows by a fixed part up
    to the budget; some of the moved and the new are born where the photos are explained worst; noise on the positions
    of the faint ones explores. No opacity resets, no gradient statistics.

    A start with more Gaussians than the budget keeps its count: they move, and none are added.
    """

    def __init__(self, config: Config, extent: float, pixels: int):
        super().__init__(config, extent, pixels)
        self.most = gaussian_budget(self.options, pixels)
        self._sums = _relocation_sums()

    @torch.no_grad()
    def change(self, iteration: int, gaussians: Gaussians, optimizer, generator, births: Births | None = None) -> bool:
        if not self._is_due(iteration):
            return False
        opacities = gaussians.opacities()
        dead = opacities <= self.options.prune_opacity
        moved, alive = dead.nonzero()[:, 0], (~dead).nonzero()[:, 0]
        count = gaussians.count
        added = self.next_count(iteration, count) - count
        if births is not None and (wanted := int(self.options.births * (len(moved) + added))):
            rows = births(wanted)
            here, moved = moved.tensor_split([len(rows["means"])])
            gaussians.overwrite({name: values[: len(here)] for name, values in rows.items()}, here, optimizer)
            rows = {name: values[len(here) :] for name, values in rows.items()}
            if new := len(rows["means"]):
                gaussians.append(rows, optimizer)
                added -= new
        if len(moved) and len(alive):
            chosen = alive[_draw(opacities[alive], len(moved), generator)]
            self._share(gaussians, chosen, optimizer)
            # In the authors' code the moved ones keep their Adam state, and only those that share lose it.
            for name, values in gaussians.rows(chosen).items():
                getattr(gaussians, name)[moved] = values
        if added > 0:
            chosen = _draw(gaussians.opacities(), added, generator)
            self._share(gaussians, chosen, optimizer)
            gaussians.append(gaussians.rows(chosen), optimizer)
        return gaussians.count > count

    def next_count(self, iteration: int, count: int) -> int:
        """How many Gaussians there are after the change at an iteration: more by `growth`, or by as much as takes the
        count to the budget by the last change, at most MOST_GROWTH."""
        growth = self.options.growth
        if growth and count < self.most:
            left = (self.stop - 1) // self.every - iteration // self.every + 1
            growth = max(growth, min((self.most / count) ** (1 / left) - 1, MOST_GROWTH))
        return max(count, min(self.most, math.ceil((1 + growth) * count)))

    def perturb(self, iteration: int, gaussians: Gaussians, means_rate: float) -> None:
        if self.options.noise:
            add_position_noise(
                gaussians.means,
                gaussians.log_scales,
                gaussians.quaternions,
                gaussians.opacity_logits,
                strength=self.options.noise * means_rate,
                # Of the iteration and not of a running generator, so that a resumed training draws what it would have.
                seed=(self.config.seed * SEED_STEP + iteration) % 2**31,
            )

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
        logits = torch.logit(part.clamp(self.options.prune_opacity, 1 - 1e-6))
        scales = gaussians.log_scales[index] + shrink.log()[:, None]
        gaussians.overwrite({"opacity_logits": logits, "log_scales": scales}, index, optimizer)
        for name in ("means", "quaternions", "harmonics_dc", "harmonics_rest"):
            gaussians.forget(name, index, optimizer)


def make_densification(config: Config, extent: float, pixels: int) -> Densification:
    """The strategy that config.densification.strategy names."""
    strategies = {"relocation": Relocation, "gradient": GradientDensification}
    return strategies[config.densification.strategy](config, extent, pixels)


def gaussian_budget(options: DensificationConfig, pixels: int) -> int:
    """The most Gaussians that relocation makes for training photos of so many pixels in all."""
    most = int(options.budget * math.sqrt(pixels)) if options.budget else options.max_gaussians
    return min(options.max_gaussians, most)


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [N, 3] turned by quaternions [N, 4] (w, x, y, z) of any length but zero."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    scalar, axis = unit[:, :1], unit[:, 1:]
    cross = 2 * torch.linalg.cross(axis, vectors)
    return vectors + scalar * cross + torch.linalg.cross(axis, cross)


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
