"""How the number of Gaussians changes during training.

GradientDensification is adaptive density control (3DGS, section 5.2, with the constants of its code); Relocation is 3D
Gaussian Splatting as Markov Chain Monte Carlo (NeurIPS 2024). Both change the Gaussians only through Gaussians.keep /
append / overwrite, which carry Adam's state.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from ..model.gaussians import PARAMETER_NAMES, Gaussians
from ..model.reserved_rows import moments_of
from ..rasterizer import Rendering
from ..rasterizer.relocation import SampledRows, clear_rows, copy_rows, count_copies, number_places, share_opacities
from ..rasterizer.training_step import add_gradient_statistics, add_position_noise
from ..runs.config import Config

SPLIT_SHRINK = 1.6  # The two halves of a split are this much smaller (3DGS: 0.8 times the number of halves)
SHORTEST_INTERVAL = 20
"""Iterations between changes are never fewer, however short the training: gradients need photos to be means of."""
SHORTEST_RESET = 300
"""Where resets would come closer together they are left out: opacities would not recover in between."""
SPARE = 1.17  # Rows in multiples of the Gaussians: changes that add a twentieth each fill them in three
MOST_GROWTH = 1.0  # A change adds at most as many as there are: each then shares with one other in the mean
PAIRS = 1 << 24  # Of Gaussians and cameras whose distances are held at once
NOISE_SIZES = 0.05
"""Position noise moves a Gaussian by at most this many of its standard deviations in a step (times a normal number)."""
FARTHEST = 100.0
"""Position noise moves no Gaussian farther than this from the origin, in normalized units (1.1 camera radii)."""
SEED_STEP = 1_000_003  # Seeds of trainings are this far apart in the seeds of their noise, one for each iteration


Births = Callable[[Tensor, int], tuple[dict[str, Tensor], Tensor]]
"""Of a number of new Gaussians that is wanted, int64 [], and one that it is not above: rows, where the photos are
explained worst, and how many of them, the first, are meant, int64 []."""


class Densification:
    """What the trainer asks of a strategy; by itself it changes nothing.

    extent: of the scene, world units. pixels: of all training photos. most: the count that no change exceeds.
    """

    def __init__(self, config: Config, extent: float, pixels: int):
        self.config, self.options, self.extent = config, config.densification, extent
        self.most = self.options.cap_max
        self.start, self.stop = (
            config.scaled(self.options.refine_start_iter),
            config.scaled(self.options.refine_stop_iter),
        )
        self.every, self.reset_every = config.scaled(self.options.refine_every), config.scaled(config.adc.reset_every)
        self.every = max(self.every, SHORTEST_INTERVAL)
        self.photos = 1
        """Iterations that the step makes at once: where several ranks train, each takes a photo."""

    def needs_gradients(self, iteration: int) -> bool:
        """Whether observe() wants the gradients of the projected means at this iteration."""
        return False

    def prepare(self, rows: int, device: torch.device | str) -> None:
        """Makes room for what observe() adds to: so many rows, of which the Gaussians are the first."""

    def room(self, iteration: int, count: int) -> int:
        """The rows that are worth having for `count` Gaussians and those that changes after an iteration may add."""
        return count if self._is_last(iteration) else max(count, min(self.most, math.ceil(SPARE * count)))

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

    def state(self, count: int) -> dict[str, Tensor]:
        """Running statistics of so many Gaussians, for a checkpoint."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Takes up the statistics of state()."""

    def _is_last(self, iteration: int) -> bool:
        """Whether no change of the count follows that of an iteration."""
        return (max(iteration, self.start) // self.every + 1) * self.every >= self.stop

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

    def prepare(self, rows: int, device: torch.device | str) -> None:
        if self.gradient_sum is None or len(self.gradient_sum) != rows:
            given = self.gradient_sum, self.seen
            self.gradient_sum, self.seen = (_with_rows(values, rows, device) for values in given)

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
            gradient = (total / seen.clamp_min(1))[: gaussians.count]
            stays, added = self._grown(gaussians, gradient, generator)
            stays, added = self._pruned(gaussians, stays, added, oversized=iteration > self.reset_every)
            if not bool(stays.all()):
                gaussians.keep(stays, optimizer)
            if len(added["means"]):
                gaussians.append(added, optimizer)
            # In place, where a recorded step adds to them.
            total.zero_()
            seen.zero_()
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

    def _grown(self, gaussians: Gaussians, gradient: Tensor, generator) -> tuple[Tensor, dict[str, Tensor]]:
        """[N] bool, which Gaussians stay as they are, and rows of those to add: clones, and halves of the others."""
        wanted = gradient > self.config.adc.grow_grad2d
        room = self.most - gaussians.count
        if int(wanted.sum()) > room:
            # Short of room, those that the image pulls at hardest go first.
            first = gradient.topk(max(room, 0)).indices
            wanted = torch.zeros_like(wanted).index_fill_(0, first, True) & wanted
        small = gaussians.log_scales.amax(1) <= math.log(self.config.adc.grow_scale3d * self.extent)
        clones, parents = (wanted & small).nonzero()[:, 0], (wanted & ~small).nonzero()[:, 0]
        added = [gaussians.rows(clones), *(self._half(gaussians, parents, generator) for _ in range(2))]
        return ~(wanted & ~small), {name: torch.cat([rows[name] for rows in added]) for name in PARAMETER_NAMES}

    def _half(self, gaussians: Gaussians, parents: Tensor, generator) -> dict[str, Tensor]:
        """One smaller Gaussian for each parent, at a point drawn from it."""
        rows = gaussians.rows(parents)
        normal = torch.randn(len(parents), 3, generator=generator, device=parents.device)
        rows["means"] += rotate(rows["quaternions"], normal * rows["log_scales"].exp())
        rows["log_scales"] -= math.log(SPLIT_SHRINK)
        return rows

    def _pruned(self, gaussians: Gaussians, stays: Tensor, added: dict[str, Tensor], oversized: bool):
        """_grown()'s without the faint and the huge; all of them where nothing else is left."""
        good, new = (self._wanted(rows, oversized) for rows in (gaussians.tensors(), added))
        good, index = stays & good, new.nonzero()[:, 0]
        if len(index) == 0 and not bool(good.any()):
            return stays, added
        return good, {name: values[index] for name, values in added.items()}

    def _wanted(self, rows: dict[str, Tensor], oversized: bool) -> Tensor:
        wanted = torch.sigmoid(rows["opacity_logits"]) >= self.options.prune_opacity
        if oversized:
            wanted &= rows["log_scales"].amax(1) <= math.log(self.config.adc.prune_scale3d * self.extent)
        return wanted

    def state(self, count: int) -> dict[str, Tensor]:
        given = {"gradient_sum": self.gradient_sum, "seen": self.seen}
        return {name: values[:count] for name, values in given.items() if values is not None}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.gradient_sum, self.seen = state.get("gradient_sum"), state.get("seen")


class Relocation(Densification):
    """Dead Gaussians move to where living ones are, in a way that keeps the image; the count grows by a fixed part up
    to the budget; some of the moved and the new are born where the photos are explained worst; noise on the positions
    of the faint ones explores. No opacity resets, no gradient statistics.

    Those that are too wide for the camera next to them can count as dead too. A start with more Gaussians than the
    budget keeps its count: they move, and none are added.
    """

    def __init__(self, config: Config, extent: float, pixels: int, places: Tensor | None = None):
        super().__init__(config, extent, pixels)
        self.most = gaussian_budget(config, pixels)
        self.places = places

    @torch.no_grad()
    def change(self, iteration: int, gaussians: Gaussians, optimizer, generator, births: Births | None = None) -> bool:
        if not self._is_due(iteration):
            return False
        count, part = gaussians.count, self.config.mcmc.seed_fraction
        added = self.next_count(iteration, count) - count
        opacities = gaussians.opacities()
        dead = (opacities <= self.options.prune_opacity) | self._veils(gaussians)
        # The device alone knows how many die: the places to be filled are those of the dead and then the new.
        places, gone = number_places(dead, added)
        gaussians.resize(count + added, optimizer)
        values, changed = list(gaussians.tensors().values()), torch.zeros_like(places, dtype=torch.bool)
        born = none = torch.zeros_like(gone)
        if births is not None and part:
            wanted = (part * (gone + added).double()).long()
            if room := _room(wanted, int(part * (count + added))):
                rows, born = births(wanted, room)
                copy_rows(values, [rows[name] for name in PARAMETER_NAMES], places, none, born, changed=changed)
        fill = partial(self._fill, gaussians, generator, places, changed)
        fill(opacities.masked_fill(dead, 0), born, gone, count)
        if added > 0:
            first = torch.maximum(gone, born)
            fill(gaussians.opacities().masked_fill_(places >= first, 0), first, gone + added, added)
        clear_rows([m for p in gaussians.parameters() for m in moments_of(optimizer, p).values()], changed)
        return added > 0

    def next_count(self, iteration: int, count: int) -> int:
        """Return the count after the change at an iteration: more by `growth_rate`, or by as much as takes the
        count to the budget by the last change, at most MOST_GROWTH."""
        growth = self.config.mcmc.growth_rate
        if growth and count < self.most:
            left = (self.stop - 1) // self.every - iteration // self.every + 1
            growth = max(growth, min((self.most / count) ** (1 / left) - 1, MOST_GROWTH))
        return max(count, min(self.most, math.ceil((1 + growth) * count)))

    def perturb(self, iteration: int, gaussians: Gaussians, means_rate: float) -> None:
        if self.config.mcmc.noise_lr:
            add_position_noise(
                gaussians.means,
                gaussians.log_scales,
                gaussians.quaternions,
                gaussians.opacity_logits,
                strength=self.config.mcmc.noise_lr * means_rate,
                most_sizes=NOISE_SIZES,
                most_distance=FARTHEST,
                # Of the iteration and not of a running generator, so that a resumed training draws what it would have.
                seed=(self.config.seed * SEED_STEP + iteration) % 2**31,
            )

    def _veils(self, gaussians: Gaussians) -> Tensor:
        """[N] whether each is wider than `prune_near_angle` allows before the nearest camera."""
        means = gaussians.means
        if self.places is None or not self.config.mcmc.prune_near_angle:
            return torch.zeros(len(means), dtype=torch.bool, device=means.device)
        exact = "donot_use_mm_for_euclid_dist"
        parts = means.split(max(1, PAIRS // len(self.places)))
        nearest = torch.cat([torch.cdist(part, self.places, compute_mode=exact).amin(1) for part in parts])
        return gaussians.log_scales.amax(1) > torch.log(self.config.mcmc.prune_near_angle * nearest)

    def _fill(self, gaussians, generator, places, changed, weights, begin: Tensor, end: Tensor, most: int) -> None:
        """Puts into the places from begin to end, at most `most`, copies of Gaussians drawn by weights, which share
        what they are with them and are marked in changed."""
        room = _room((end - begin).clamp_min(0), most)
        if not room:
            return
        drawn = _draw(weights, room, generator)
        copies = count_copies(drawn, begin, end, changed)
        least = self.options.prune_opacity
        share_opacities(gaussians.opacity_logits.detach(), gaussians.log_scales.detach(), copies, least=least)
        values = list(gaussians.tensors().values())
        # In the authors' code the moved ones keep their Adam state, and only those that share lose it.
        copy_rows(values, values, places, begin, end, samples=drawn)


def make_densification(config: Config, extent: float, pixels: int, places: Tensor | None = None) -> Densification:
    """The strategy that config.densification.strategy names; places: [V, 3] of the training cameras."""
    if config.densification.strategy == "adc":
        return GradientDensification(config, extent, pixels)
    return Relocation(config, extent, pixels, places)


def gaussian_budget(config: Config, pixels: int) -> int:
    """Return the largest number of Gaussians that "mcmc" makes for training photos of so many pixels in total."""
    most, density = config.densification.cap_max, config.mcmc.cap_density
    return min(most, int(density * math.sqrt(pixels))) if density else most


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [N, 3] turned by quaternions [N, 4] (w, x, y, z) of any length but zero."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    scalar, axis = unit[:, :1], unit[:, 1:]
    cross = 2 * torch.linalg.cross(axis, vectors)
    return vectors + scalar * cross + torch.linalg.cross(axis, cross)


def _with_rows(values: Tensor | None, rows: int, device) -> Tensor:
    """The first of values, and zeros behind them."""
    made = torch.zeros(rows, device=device)
    if values is not None:
        made[: len(values)] = values[:rows]
    return made


def _room(number: Tensor, most: int) -> int:
    """Room for a number of things, of which there are at most so many: a GPU is not waited for to tell it."""
    return min(most, int(number)) if number.device.type == "cpu" else most


def _draw(weights: Tensor, count: int, generator) -> SampledRows:
    """Rows drawn in proportion to weights, with replacement; by bisection, for any number of weights."""
    steps = weights.double().cumsum(0)
    uniform = torch.rand(count, generator=generator, device=weights.device, dtype=torch.float64)
    # Not 0, which the first would be drawn by, whatever it weighs.
    uniform = uniform.clamp_min_(torch.finfo(torch.float64).tiny)
    return SampledRows(torch.searchsorted(steps, uniform * steps[-1]).clamp_max_(len(weights) - 1), steps[-1])
