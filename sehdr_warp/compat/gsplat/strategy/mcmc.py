"""3DGS-MCMC (Kheradmand et al. 2024)."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ....rasterizer.ops.relocation import MOST_COPIES
from ..parameter_rows import Optimizers, Parameters
from .base import State, Strategy
from .ops import inject_noise_to_position, relocate, sample_add


@dataclass
class MCMCStrategy(Strategy):
    """3DGS-MCMC: move Gaussians without opacity to others, add some, and add noise to all means.

    Attributes:
        cap_max: largest number of Gaussians.
        noise_lr: noise as a multiple of the learning rate of the means.
        refine_start_iter: first iteration of changes.
        refine_stop_iter: last one.
        refine_every: iterations between changes.
        min_opacity: Gaussians with no larger opacity are moved.
        verbose: print what changed.
        noise_injection_stop_iter: first iteration without noise; -1 for none.
        noise_opacity_t: opacity at which the noise is half of that of a transparent Gaussian.
        noise_opacity_k: how fast the noise fades with the opacity there.
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    refine_every: int = 100
    min_opacity: float = 0.005
    verbose: bool = False
    noise_injection_stop_iter: int = -1
    noise_opacity_t: float = 0.005
    noise_opacity_k: float = 100.0

    def initialize_state(self) -> State:
        """Return the state that the steps take: gsplat's table of binomials, for steps of your own."""
        numbers = range(MOST_COPIES)
        return {"binoms": torch.tensor([[float(math.comb(n, k)) for k in numbers] for n in numbers])}

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: State,
        step: int,
        info: dict[str, Any],
        lr: float,
        scene: Any = None,
    ) -> None:
        """Move and add Gaussians in their turn, and add noise.

        lr: learning rate of the means. scene: a gsplat 1.6 Scene, whose methods on_relocate() and the like are called.
        """
        if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
            binoms = state.get("binoms")
            if binoms is not None:
                binoms = state["binoms"] = binoms.to(params["means"].device)
            options = {} if scene is None else {"scene": scene}
            moved = self._relocate_gs(params, optimizers, binoms, **options)
            added = self._add_new_gs(params, optimizers, binoms, **options)
            if self.verbose:
                print(f"Step {step}: {moved} Gaussians moved, {added} added; {len(params['means'])} now.")
        if self.noise_injection_stop_iter < 0 or step < self.noise_injection_stop_iter:
            fading = self.noise_opacity_t, self.noise_opacity_k
            inject_noise_to_position(params, optimizers, {}, lr * self.noise_lr, *fading)

    def _relocate_gs(self, params: Parameters, optimizers: Optimizers, binoms: Tensor | None, scene: Any = None) -> int:
        dead = params["opacities"].detach().flatten().sigmoid() <= self.min_opacity
        relocate(params, optimizers, {}, dead, binoms, self.min_opacity, scene)
        return 0 if bool(dead.all()) else int(dead.sum())

    def _add_new_gs(self, params: Parameters, optimizers: Optimizers, binoms: Tensor | None, scene: Any = None) -> int:
        count = len(params["means"])
        added = max(0, min(self.cap_max, int(1.05 * count)) - count)
        if added:
            sample_add(params, optimizers, {}, added, binoms, self.min_opacity, scene)
        return added
