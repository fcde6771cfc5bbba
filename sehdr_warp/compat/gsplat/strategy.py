"""gsplat's strategies of densification, on any device.

DefaultStrategy is the adaptive density control of 3DGS (Kerbl et al. 2023) with the absolute gradients of AbsGS (Ye et
al. 2024); MCMCStrategy is 3DGS-MCMC (Kheradmand et al. 2024). They take parameters "means", "scales" (logarithms),
"quats", "opacities" (logits) and any others by name, with one optimizer for each.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ...rasterizer.checks import check_shape, check_tensors
from ...rasterizer.ops.relocation import MOST_COPIES, relocation_sums
from .parameter_rows import Optimizers, Parameters, change_rows, write_rows
from .projection import rotation_matrices

State = dict[str, Any]
REQUIRED = "means", "scales", "quats", "opacities"
SPLIT_SHRINK = 1.6  # Both parts of a split Gaussian are this many times smaller.


@dataclass
class Strategy:
    """Interface of strategies."""

    def check_sanity(self, params: Parameters, optimizers: Optimizers) -> None:
        """Raise ValueError unless there is one optimizer with one group for each trainable parameter."""
        trainable = {name for name, value in params.items() if value.requires_grad}
        if trainable != set(optimizers):
            raise ValueError(f"there are parameters {sorted(trainable)}, but optimizers {sorted(optimizers)}")
        for name, optimizer in optimizers.items():
            if len(optimizer.param_groups) != 1:
                raise ValueError(f"the optimizer of {name} has {len(optimizer.param_groups)} groups, expected 1")
        if missing := set(REQUIRED) - set(params):
            raise ValueError(f"there is no parameter {', '.join(sorted(missing))}")

    def step_pre_backward(self, *args: Any, **kwargs: Any) -> None:
        """Prepare what the backward pass has to keep."""

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """Change the Gaussians after the backward pass."""


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
        self._collect(params, state, info, packed)
        in_turn = step > self.refine_start_iter and step % self.refine_every == 0
        if in_turn and step % self.reset_every >= self.pause_refine_after_reset:
            duplicated, split = self._grow(params, optimizers, state, step, scene)
            pruned = self._prune(params, optimizers, state, step, scene)
            if self.verbose:
                print(
                    f"Step {step}: {duplicated} Gaussians duplicated, {split} split, {pruned} pruned; "
                    f"{len(params['means'])} now."
                )
            for name in ("grad2d", "count", "radii"):
                if state.get(name) is not None:
                    state[name].zero_()
        if step > 0 and step % self.reset_every == 0:
            highest = math.log(2 * self.prune_opa / (1 - 2 * self.prune_opa))
            write_rows(params, optimizers, {"opacities": params["opacities"].clamp(max=highest)})

    def _collect(self, params: Parameters, state: State, info: dict[str, Any], packed: bool) -> None:
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

    def _grow(self, params: Parameters, optimizers: Optimizers, state: State, step: int, scene: Any) -> tuple[int, int]:
        high = state["grad2d"] / state["count"].clamp_min(1) > self.grow_grad2d
        small = params["scales"].exp().amax(-1) <= self.grow_scale3d * state["scene_scale"]
        copied, split = high & small, high & ~small
        if step < self.refine_scale2d_stop_iter:
            split = split | (state["radii"] > self.grow_scale2d)
        copied_rows, split_rows = copied.nonzero()[:, 0], split.nonzero()[:, 0]
        values = self._split(params, split_rows)
        appended = {
            name: torch.cat(
                [value.detach()[copied_rows], values.get(name, torch.cat([value.detach()[split_rows]] * 2))]
            )
            for name, value in params.items()
        }
        sources = torch.cat([copied_rows, split_rows, split_rows])
        change_rows(params, optimizers, state, ~split, appended, sources)
        if scene is not None:
            scene.on_duplicate(copied_rows)
            copies = torch.arange(len(copied_rows), device=split.device) + len(split)
            scene.on_split(split_rows, torch.cat([(~split).nonzero()[:, 0], copies]))
        return len(copied_rows), len(split_rows)

    def _split(self, params: Parameters, rows: Tensor) -> dict[str, Tensor]:
        """Return what differs of the two parts of each split Gaussian, [2 * rows, ...]."""
        sizes = params["scales"].detach()[rows].exp()
        axes = rotation_matrices(params["quats"].detach()[rows]) * sizes[:, None, :]
        offsets = torch.einsum("nij,knj->kni", axes, torch.randn(2, *sizes.shape, device=axes.device, dtype=axes.dtype))
        values = {
            "means": (params["means"].detach()[rows] + offsets).flatten(0, 1),
            "scales": (sizes / SPLIT_SHRINK).log().repeat(2, 1),
        }
        if self.revised_opacity:
            logits = params["opacities"].detach()[rows]
            halves = torch.logit(1 - (1 - logits.sigmoid()).clamp_min(0.0).sqrt())
            values["opacities"] = torch.cat([halves, halves])
        return values

    def _prune(self, params: Parameters, optimizers: Optimizers, state: State, step: int, scene: Any) -> int:
        removed = params["opacities"].flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            large = params["scales"].exp().amax(-1) > self.prune_scale3d * state["scene_scale"]
            if step < self.refine_scale2d_stop_iter:
                large = large | (state["radii"] > self.prune_scale2d)
            removed = removed | large
        count = int(removed.sum())
        if count:
            change_rows(params, optimizers, state, ~removed)
            if scene is not None:
                scene.on_remove(removed)
        return count


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
        """Return the state that the steps take; it is empty."""
        return {}

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
            moved = self._relocate(params, optimizers, scene)
            added = self._add(params, optimizers, scene)
            if self.verbose:
                print(f"Step {step}: {moved} Gaussians moved, {added} added; {len(params['means'])} now.")
        if self.noise_injection_stop_iter < 0 or step < self.noise_injection_stop_iter:
            self._add_noise(params, lr * self.noise_lr)

    def _relocate(self, params: Parameters, optimizers: Optimizers, scene: Any) -> int:
        opacities = params["opacities"].detach().flatten().sigmoid()
        dead = opacities <= self.min_opacity
        targets, alive = dead.nonzero()[:, 0], (~dead).nonzero()[:, 0]
        if not len(targets) or not len(alive):
            return 0
        sources = alive[_draw(opacities[alive], len(targets))]
        self._share(params, sources)
        values = {name: value.detach().clone() for name, value in params.items()}
        for value in values.values():
            value[targets] = value[sources]
        write_rows(params, optimizers, values, sources)
        if scene is not None:
            scene.on_relocate(targets, sources)
        return len(targets)

    def _add(self, params: Parameters, optimizers: Optimizers, scene: Any) -> int:
        count = len(params["means"])
        added = max(0, min(self.cap_max, int(1.05 * count)) - count)
        if not added:
            return 0
        sources = _draw(params["opacities"].detach().flatten().sigmoid(), added)
        self._share(params, sources)
        single = torch.ones(count, dtype=torch.bool, device=sources.device)
        change_rows(params, optimizers, {}, single, {name: v.detach()[sources] for name, v in params.items()})
        if scene is not None:
            scene.on_sample_add(sources)
        return added

    def _share(self, params: Parameters, sources: Tensor) -> None:
        """Give each source the opacity and size that it and its copies have together (equation 9)."""
        copies = torch.bincount(sources, minlength=len(params["means"]))
        rows = copies.nonzero()[:, 0]
        logits = params["opacities"].detach()
        opacities, sizes = compute_relocation(
            logits.flatten()[rows].sigmoid(), params["scales"].detach()[rows].exp(), copies[rows] + 1
        )
        opacities = opacities.clamp(self.min_opacity, 1 - torch.finfo(torch.float32).eps)
        logits[rows] = opacities.logit().view_as(logits[rows])
        params["scales"].detach()[rows] = sizes.log()

    def _add_noise(self, params: Parameters, strength: float) -> None:
        """Add noise with each Gaussian's covariance, which fades above the opacity noise_opacity_t (equation 8)."""
        means, opacities = params["means"].detach(), params["opacities"].detach().flatten().sigmoid()
        axes = rotation_matrices(params["quats"].detach()) * params["scales"].detach().exp()[:, None, :]
        fade = torch.sigmoid(self.noise_opacity_k * (self.noise_opacity_t - opacities))
        noise = torch.randn_like(means) * (fade * strength)[:, None]
        means += (axes @ (axes.transpose(1, 2) @ noise[:, :, None]))[..., 0]


def _draw(weights: Tensor, count: int) -> Tensor:
    """Return `count` indices drawn with replacement, by weights of any number."""
    steps = weights.double().cumsum(0)
    places = torch.searchsorted(steps, torch.rand(count, dtype=torch.float64, device=weights.device) * steps[-1])
    return places.clamp_max(len(weights) - 1)


@torch.no_grad()
def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return opacities and sizes with which `ratios` Gaussians at one place look as one did (equation 9).

    Args:
        opacities: [N] in (0, 1).
        scales: [N, 3].
        ratios: [N], from 1; more than 51 count as 51.
        binoms: has no effect; gsplat's table of binomials.

    Raises:
        TypeError: for what is not a tensor.
        ValueError: for shapes, dtypes or devices that do not fit.
    """
    check_tensors(opacities=(opacities, ("N",)), scales=(scales, ("N", 3)))
    check_shape("ratios", ratios, opacities.shape)
    count = ratios.long().clamp(1, MOST_COPIES)
    shared = 1 - (1 - opacities.double()).pow(1 / count)
    powers = shared[:, None] ** torch.arange(1, MOST_COPIES + 1, device=opacities.device)
    denominators = (relocation_sums(opacities.device)[count - 1] * powers).sum(1)
    factors = (opacities.double() / denominators).to(scales.dtype)
    return shared.to(opacities.dtype), scales * factors[:, None]
