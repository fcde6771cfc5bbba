"""gsplat's changes of Gaussians: parameters and the state of their optimizers together, in place.

`params` and `optimizers` are those of a strategy, `state` has statistics whose tensors of N rows follow, and `scene` is
None or a Scene of gsplat 1.6, whose method on_duplicate() or the like is called.
"""

from typing import Any

import torch
from torch import Tensor

from ....rasterizer.checks import check_shape, real
from ..parameter_rows import Optimizers, Parameters, change_rows, write_rows
from ..projection import rotation_matrices
from ..relocation import compute_relocation
from .base import State

SPLIT_SHRINK = 1.6  # Both parts of a split Gaussian are this many times smaller.


@torch.no_grad()
def duplicate(params: Parameters, optimizers: Optimizers, state: State, mask: Tensor, scene: Any = None) -> None:
    """Append a copy of each Gaussian of a mask [N]."""
    _check_mask(params, mask)
    rows = mask.nonzero()[:, 0]
    copies = {name: value.detach()[rows] for name, value in params.items()}
    change_rows(params, optimizers, state, torch.ones_like(mask), copies, rows)
    if scene is not None:
        scene.on_duplicate(rows)


@torch.no_grad()
def split(
    params: Parameters,
    optimizers: Optimizers,
    state: State,
    mask: Tensor,
    revised_opacity: bool = False,
    scene: Any = None,
) -> None:
    """Replace each Gaussian of a mask [N] by two smaller ones behind the others, at places drawn from it.

    revised_opacity: both together are as opaque as it was (Rota Bulo et al. 2024).
    """
    _check_mask(params, mask)
    rows, others = mask.nonzero()[:, 0], (~mask).nonzero()[:, 0]
    parts = {name: torch.cat([value.detach()[rows]] * 2) for name, value in params.items()}
    sizes = parts["scales"].exp()
    noise = sizes * torch.randn_like(sizes)
    parts["means"] = parts["means"] + (rotation_matrices(parts["quats"]) @ noise[..., None])[..., 0]
    parts["scales"] = (sizes / SPLIT_SHRINK).log()
    if revised_opacity:
        parts["opacities"] = torch.logit(1 - (1 - parts["opacities"].sigmoid()).clamp_min(0.0).sqrt())
    change_rows(params, optimizers, state, ~mask, parts, torch.cat([rows, rows]))
    if scene is not None:
        scene.on_split(rows, others)


@torch.no_grad()
def remove(params: Parameters, optimizers: Optimizers, state: State, mask: Tensor, scene: Any = None) -> None:
    """Remove the Gaussians of a mask [N]."""
    _check_mask(params, mask)
    change_rows(params, optimizers, state, ~mask)
    if scene is not None:
        scene.on_remove(mask)


@torch.no_grad()
def reset_opa(params: Parameters, optimizers: Optimizers, state: State, value: float) -> None:
    """Lower opacities to at most `value`."""
    real("value", value, lambda number: 0 < number <= 1, "above 0 and at most 1; a strategy's is twice its prune_opa")
    highest = torch.logit(torch.tensor(value, dtype=torch.float64)).item()
    write_rows(params, optimizers, {"opacities": params["opacities"].clamp(max=highest)})


@torch.no_grad()
def relocate(
    params: Parameters,
    optimizers: Optimizers,
    state: State,
    mask: Tensor,
    binoms: Tensor | None = None,
    min_opacity: float = 0.005,
    scene: Any = None,
) -> None:
    """Move the Gaussians of a mask [N] to others, drawn by opacity, that then share what they had.

    binoms: as of compute_relocation(). min_opacity: least opacity of those that share.
    """
    _check_mask(params, mask)
    targets, others = mask.nonzero()[:, 0], (~mask).nonzero()[:, 0]
    if not len(targets) or not len(others):
        return
    sources = others[_draw(params["opacities"].detach().flatten()[others].sigmoid(), len(targets))]
    _share(params, sources, binoms, min_opacity)
    values = {name: value.detach().clone() for name, value in params.items()}
    for value in values.values():
        value[targets] = value[sources]
    write_rows(params, optimizers, values, sources)
    for value in state.values():
        if isinstance(value, Tensor) and value.ndim and len(value) == len(mask):
            value[sources] = 0
    if scene is not None:
        scene.on_relocate(targets, sources)


@torch.no_grad()
def sample_add(
    params: Parameters,
    optimizers: Optimizers,
    state: State,
    n: int,
    binoms: Tensor | None = None,
    min_opacity: float = 0.005,
    scene: Any = None,
) -> None:
    """Append n copies of Gaussians, drawn by opacity, that then share what they had; binoms as of relocate()."""
    opacities = params["opacities"].detach().flatten().sigmoid()
    sources = _draw(opacities, n)
    _share(params, sources, binoms, min_opacity)
    copies = {name: value.detach()[sources] for name, value in params.items()}
    change_rows(params, optimizers, state, torch.ones_like(opacities, dtype=torch.bool), copies)
    if scene is not None:
        scene.on_sample_add(sources)


@torch.no_grad()
def inject_noise_to_position(
    params: Parameters, optimizers: Optimizers, state: State, scaler: float, t: float = 0.005, k: float = 100.0
) -> None:
    """Add noise with each Gaussian's covariance times `scaler` (equation 8 of 3DGS-MCMC).

    t: opacity at which the noise is half of that of a transparent Gaussian. k: how fast it fades with opacity there.
    """
    means, opacities = params["means"].detach(), params["opacities"].detach().flatten().sigmoid()
    axes = rotation_matrices(params["quats"].detach()) * params["scales"].detach().exp()[:, None, :]
    noise = torch.randn_like(means) * (torch.sigmoid(k * (t - opacities)) * scaler)[:, None]
    means += (axes @ (axes.transpose(1, 2) @ noise[:, :, None]))[..., 0]


def _check_mask(params: Parameters, mask: Tensor) -> None:
    """Raise TypeError or ValueError for what is no mask [N]; numbers would be indices."""
    check_shape("mask", mask, (len(next(iter(params.values()))),))
    if mask.dtype != torch.bool:
        raise ValueError(f"mask is {mask.dtype}, expected torch.bool")


def _draw(weights: Tensor, count: int) -> Tensor:
    """Return `count` indices drawn with replacement, by weights of any number."""
    steps = weights.double().cumsum(0)
    places = torch.searchsorted(steps, torch.rand(count, dtype=torch.float64, device=weights.device) * steps[-1])
    return places.clamp_max(len(weights) - 1)


def _share(params: Parameters, sources: Tensor, binoms: Tensor | None, min_opacity: float) -> None:
    """Give each source the opacity and size that it and its copies have together (equation 9)."""
    copies = torch.bincount(sources, minlength=len(params["means"]))
    rows = copies.nonzero()[:, 0]
    logits = params["opacities"].detach()
    opacities, sizes = compute_relocation(
        logits.flatten()[rows].sigmoid(), params["scales"].detach()[rows].exp(), copies[rows] + 1, binoms
    )
    opacities = opacities.clamp(min_opacity, 1 - torch.finfo(torch.float32).eps)
    logits[rows] = opacities.logit().view_as(logits[rows])
    params["scales"].detach()[rows] = sizes.log()
