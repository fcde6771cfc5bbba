"""Adaptive density control of 3DGS (Kerbl et al. 2023) with the absolute gradients of AbsGS (Ye et al. 2024)."""

from dataclasses import dataclass
from typing import Any

import torch

from ..parameter_rows import Optimizers, Parameters
from .base import State, Strategy
from .ops import duplicate, remove, reset_opa, split


@dataclass
class DefaultStrategy(Strategy):
    """Adaptive density control: duplicate, split, prune, and reset opacities.

    Attributes:
        prune_opa: Gaussians with a lower opacity are removed.
        grow_grad2d: Gaussians whose mean gradient by the 2D mean is larger are duplicated or split; in units of half
            the image. With absgrad about 0.0008.
        grow_scale3d: up to this size, as a part of scene_scale, they are duplicated, else split.
        grow_scale2d: Gaussians with a larger radius, as a part of the image, are split.
        prune_scale3d: larger Gaussians, as a part of scene_scale, are removed after the first reset.
        prune_scale2d: likewise by their radius, as a part of the image.
        refine_scale2d_stop_iter: radii count up to this iteration; 0 disables that.
        refine_start_iter: first iteration of densification.
        refine_stop_iter: last one.
        reset_every: iterations between resets of opacities.
        refine_every: iterations between densifications.
        pause_refine_after_reset: iterations without densification after a reset.
        absgrad: use absolute gradients; rasterization() must be called with absgrad=True.
        revised_opacity: opacities of split Gaussians by Rota Bulo et al. 2024.
        verbose: print what changed.
        key_for_gradient: key of the 2D means in `info`.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    absgrad: bool = False
    revised_opacity: bool = False
    verbose: bool = False
    key_for_gradient: str = "means2d"

    def initialize_state(self, scene_scale: float = 1.0) -> State:
        """Return the state that the steps take. scene_scale: size of the scene in its units."""
        state: State = {"grad2d": None, "count": None, "scene_scale": scene_scale}
        return state | ({"radii": None} if self.refine_scale2d_stop_iter > 0 else {})

    def step_pre_backward(
        self, params: Parameters, optimizers: Optimizers, state: State, step: int, info: dict[str, Any]
    ) -> None:
        """Let the backward pass keep the gradient of the 2D means."""
        info[self.key_for_gradient].retain_grad()

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: State,
        step: int,
        info: dict[str, Any],
        packed: bool = False,
        scene: Any = None,
    ) -> None:
        """Collect the gradients of the 2D means and, in its turn, densify, prune and reset.

        packed: as rendered. scene: a gsplat 1.6 Scene, whose methods on_duplicate() and the like are called.
        """
        if step >= self.refine_stop_iter:
            return
        self._update_state(params, state, info, packed=packed)
        in_turn = step > self.refine_start_iter and step % self.refine_every == 0
        if in_turn and step % self.reset_every >= self.pause_refine_after_reset:
            options = {} if scene is None else {"scene": scene}
            duplicated, divided = self._grow_gs(params, optimizers, state, step, **options)
            pruned = self._prune_gs(params, optimizers, state, step, **options)
            if self.verbose:
                print(
                    f"Step {step}: {duplicated} Gaussians duplicated, {divided} split, {pruned} pruned; "
                    f"{len(params['means'])} now."
                )
            for name in ("grad2d", "count", "radii"):
                if state.get(name) is not None:
                    state[name].zero_()
        if step > 0 and step % self.reset_every == 0:
            reset_opa(params, optimizers, state, 2 * self.prune_opa)

    def _update_state(self, params: Parameters, state: State, info: dict[str, Any], packed: bool = False) -> None:
        means2d, cameras = info[self.key_for_gradient], info["n_cameras"]
        gradients = getattr(means2d, "absgrad" if self.absgrad else "grad", None)
        if gradients is None:
            remedy = "render with absgrad=True" if self.absgrad else "call step_pre_backward() before loss.backward()"
            raise ValueError(f"info[{self.key_for_gradient!r}] has no gradient; {remedy}")
        half_image = gradients.new_tensor([info["width"], info["height"]]) / 2
        lengths = (gradients * half_image * cameras).norm(dim=-1)
        radii = info["radii"].amax(-1)
        if packed:
            rows = info["gaussian_ids"]
        else:
            visible = (info["radii"] > 0).all(-1)
            rows = visible.nonzero()[:, -1]
            lengths, radii = lengths[visible], radii[visible]
        count = len(params["means"])
        for name in ("grad2d", "count", "radii"):
            if name in state and state[name] is None:
                state[name] = gradients.new_zeros(count)
        state["grad2d"].index_add_(0, rows, lengths)
        state["count"].index_add_(0, rows, torch.ones_like(lengths))
        if "radii" in state:
            parts = radii / max(info["width"], info["height"])
            state["radii"].scatter_reduce_(0, rows, parts.to(state["radii"].dtype), "amax")

    def _grow_gs(
        self, params: Parameters, optimizers: Optimizers, state: State, step: int, scene: Any = None
    ) -> tuple[int, int]:
        high = state["grad2d"] / state["count"].clamp_min(1) > self.grow_grad2d
        small = params["scales"].exp().amax(-1) <= self.grow_scale3d * state["scene_scale"]
        to_copy, to_split = high & small, high & ~small
        if step < self.refine_scale2d_stop_iter:
            to_split = to_split | (state["radii"] > self.grow_scale2d)
        counts = int(to_copy.sum()), int(to_split.sum())
        if counts[0]:
            duplicate(params, optimizers, state, to_copy, scene)
        if counts[1]:  # Copies are not split.
            mask = torch.cat([to_split, to_split.new_zeros(counts[0])])
            split(params, optimizers, state, mask, self.revised_opacity, scene)
        return counts

    def _prune_gs(self, params: Parameters, optimizers: Optimizers, state: State, step: int, scene: Any = None) -> int:
        removed = params["opacities"].flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            large = params["scales"].exp().amax(-1) > self.prune_scale3d * state["scene_scale"]
            if step < self.refine_scale2d_stop_iter:
                large = large | (state["radii"] > self.prune_scale2d)
            removed = removed | large
        count = int(removed.sum())
        if count:
            remove(params, optimizers, state, removed, scene)
        return count
