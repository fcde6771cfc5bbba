"""How the number of Gaussians changes during training.

GradientDensification is adaptive density control (3DGS, section 5.2, with the constants of its code); relocation.py
holds 3DGS-MCMC. Both change the Gaussians only through Gaussians.keep / append / overwrite, which carry Adam's state.
"""

import math

import torch
from torch import Tensor

from ..field.gaussians import Gaussians
from ..splatting import Rendering
from ..splatting.training_step import add_gradient_statistics
from .config import Config

SPLIT_SHRINK = 1.6
"""The two halves of a split are this much smaller (3DGS: 0.8 times the number of halves)."""

SHORTEST_INTERVAL = 20
"""Iterations between changes are never fewer, however short the training: gradients need photos to be means of."""
SHORTEST_RESET = 300
"""Where resets would come closer together they are left out: opacities would not recover in between."""


class Densification:
    """What the trainer asks of a strategy; by itself it changes nothing."""

    def __init__(self, config: Config, extent: float):
        self.config = config
        self.options = config.densification
        self.extent = extent
        self.most = self.options.max_gaussians
        self.start, self.stop, self.every, self.reset_every = (
            config.scaled(number)
            for number in (self.options.start, self.options.stop, self.options.every, self.options.reset_every)
        )
        self.every = max(self.every, SHORTEST_INTERVAL)

    def needs_gradients(self, iteration: int) -> bool:
        """Whether observe() wants the gradients of the projected means at this iteration."""
        return False

    def prepare(self, count: int, device: torch.device | str) -> None:
        """Makes room for what observe() adds to."""

    def observe(self, rendering: Rendering, width: int, height: int, usable: Tensor) -> None:
        """Takes note of a step's image gradients. usable: scalar tensor, 0 where the step is to be ignored."""

    def change(self, iteration: int, gaussians: Gaussians, optimizer: torch.optim.Optimizer, generator) -> bool:
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
        return self.start < iteration < self.stop and iteration % self.every == 0


class GradientDensification(Densification):
    """Clones small and splits large Gaussians where the image pulls at them, prunes the faint and the huge, and
    resets opacities now and then so that only what is needed grows back."""

    def __init__(self, config: Config, extent: float):
        super().__init__(config, extent)
        self.gradient_sum: Tensor | None = None
        self.seen: Tensor | None = None

    def needs_gradients(self, iteration: int) -> bool:
        return iteration < self.stop

    def prepare(self, count: int, device: torch.device | str) -> None:
        if self.gradient_sum is None:
            self.gradient_sum, self.seen = torch.zeros(count, device=device), torch.zeros(count, device=device)

    @torch.no_grad()
    def observe(self, rendering: Rendering, width: int, height: int, usable: Tensor) -> None:
        gradient = rendering.means2d.grad
        statistics = self.gradient_sum, self.seen
        add_gradient_statistics(gradient, rendering.radii, usable, width, height, *statistics)

    def change(self, iteration: int, gaussians: Gaussians, optimizer: torch.optim.Optimizer, generator) -> bool:
        changed = False
        if self._is_due(iteration) and self.gradient_sum is not None:
            gradient = self.gradient_sum / self.seen.clamp_min(1)
            self._grow(gaussians, gradient, optimizer, generator)
            self._prune(gaussians, optimizer, oversized=iteration > self.reset_every)
            self.gradient_sum = self.seen = None
            changed = True
        if iteration < self.stop and iteration % self.reset_every == 0 and self.reset_every >= SHORTEST_RESET:
            self._reset_opacities(gaussians, optimizer)
        return changed

    @torch.no_grad()
    def _grow(self, gaussians: Gaussians, gradient: Tensor, optimizer, generator) -> None:
        wanted = gradient > self.options.grow_gradient
        room = self.options.max_gaussians - gaussians.count
        if int(wanted.sum()) > room:
            if room <= 0:
                return
            # Short of room, those that the image pulls at hardest go first.
            wanted = torch.zeros_like(wanted).index_fill_(0, gradient.topk(room).indices, True) & wanted
        small = gaussians.log_scales.amax(1) <= math.log(self.options.grow_scale * self.extent)
        clones, parents = (wanted & small).nonzero()[:, 0], (wanted & ~small).nonzero()[:, 0]
        if len(clones) + len(parents) == 0:
            return
        added = [gaussians.rows(clones)]
        added += [self._half(gaussians, parents, generator) for _ in range(2)]
        kept = torch.ones_like(wanted).index_fill_(0, parents, False)
        if len(parents):
            gaussians.keep(kept, optimizer)
        gaussians.append({name: torch.cat([rows[name] for rows in added]) for name in added[0]}, optimizer)

    def _half(self, gaussians: Gaussians, parents: Tensor, generator) -> dict[str, Tensor]:
        """One smaller Gaussian for each parent, at a point drawn from it."""
        rows = gaussians.rows(parents)
        normal = torch.randn(len(parents), 3, generator=generator, device=parents.device)
        offsets = rotate(rows["quaternions"], normal * rows["log_scales"].exp())
        rows["means"] += offsets
        rows["log_scales"] -= math.log(SPLIT_SHRINK)
        return rows

    @torch.no_grad()
    def _prune(self, gaussians: Gaussians, optimizer, oversized: bool) -> None:
        unwanted = gaussians.opacities() < self.options.prune_opacity
        if oversized:
            unwanted |= gaussians.log_scales.amax(1) > math.log(self.options.prune_scale * self.extent)
        if 0 < int(unwanted.sum()) < gaussians.count:
            gaussians.keep(~unwanted, optimizer)

    @torch.no_grad()
    def _reset_opacities(self, gaussians: Gaussians, optimizer) -> None:
        value = 2 * self.options.prune_opacity
        ceiling = math.log(value / (1 - value))
        gaussians.overwrite({"opacity_logits": gaussians.opacity_logits.clamp_max(ceiling)}, optimizer=optimizer)

    def state(self) -> dict[str, Tensor]:
        return {} if self.gradient_sum is None else {"gradient_sum": self.gradient_sum, "seen": self.seen}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.gradient_sum, self.seen = state.get("gradient_sum"), state.get("seen")


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [N, 3] turned by quaternions [N, 4] (w, x, y, z) of any length but zero."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    scalar, axis = unit[:, :1], unit[:, 1:]
    cross = 2 * torch.linalg.cross(axis, vectors)
    return vectors + scalar * cross + torch.linalg.cross(axis, cross)


def make_densification(config: Config, extent: float, pixels: int) -> Densification:
    """The strategy that config.densification.strategy names; extent: the scene's, in world units; pixels: of all
    training photos."""
    from .relocation import Relocation

    if config.densification.strategy == "relocation":
        return Relocation(config, extent, pixels)
    return GradientDensification(config, extent)
