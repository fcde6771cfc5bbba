"""One-sided comparison of exposures by the mu-law as a torch operation (kernels/one_sided.py)."""

import math

import torch

from ..kernels.one_sided import one_sided_kernel
from .launching import launch, warp_scalar


def seen_by_photo(
    light: torch.Tensor,
    photo_light: torch.Tensor,
    clipped: torch.Tensor | None,
    black: torch.Tensor | None,
    *,
    white: float,
    mu: float,
    half_codes: tuple[float, float],
) -> tuple[torch.Tensor, torch.Tensor]:
    """What a photo can tell of simulated exposures, and what it tells, both as log(1 + mu x / white) / log(1 + mu).

    light, photo_light: [...] exposures x, simulated and of the photo; clipped, black: [...] bool or None, where the
    photo is saturated. There the first result equals the second as soon as it is above (clipped) or below (black) it,
    or within half_codes of it: (below white, above black), in the results' domain. Differentiable once with respect to
    light.
    light and photo_light share a type, float32 or float64; all share one shape and device. Raises ValueError otherwise.
    """
    others = {"photo_light": (photo_light, light.dtype), "clipped": (clipped, torch.bool), "black": (black, torch.bool)}
    for name, (tensor, dtype) in others.items():
        if tensor is not None and (tensor.shape != light.shape or tensor.dtype != dtype):
            raise ValueError(f"{name} is {tensor.dtype} {list(tensor.shape)}, expected {dtype} {list(light.shape)}")
    return _SeenByPhoto.apply(light, photo_light, clipped, black, mu / white, 1 / math.log1p(mu), half_codes)


class _SeenByPhoto(torch.autograd.Function):
    @staticmethod
    def forward(ctx, light, photo_light, clipped, black, scale, gain, half_codes):
        light = light.detach().contiguous()
        seen, slopes, truth = (torch.empty_like(light) for _ in range(3))
        none = torch.empty(0, dtype=torch.bool, device=light.device)
        given = [light, photo_light.detach().contiguous()]
        given += [none if mask is None else mask.contiguous() for mask in (clipped, black)]
        kernel = one_sided_kernel(warp_scalar(light.dtype))
        launch(kernel, light.numel(), *given, scale, gain, *half_codes, seen, slopes, truth)
        ctx.save_for_backward(slopes)
        ctx.mark_non_differentiable(truth)
        ctx.set_materialize_grads(False)  # of truth there is none, and no zeros are wanted in its place
        return seen, truth

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_seen, _):
        (slopes,) = ctx.saved_tensors
        by_light = None if by_seen is None else by_seen * slopes
        return by_light, None, None, None, None, None, None
