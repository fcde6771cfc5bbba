"""What a training does at every step beside rendering, on either device without waiting for it."""

import math
from typing import Any

import torch
from torch import Tensor

from ..kernels import training_step as kernels
from .harmonics import HarmonicsGradients
from .launching import launch


@torch.no_grad()
def judge_step(loss: Tensor, norms: Tensor, incomplete: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Three scalars, 1 or 0: whether the loss or a norm is not finite; whether a step is therefore, or as `incomplete`
    is true, to be skipped; whether it is to be made. loss: float32 scalar; norms: [K] float32; incomplete: bool scalar.
    """
    verdict = norms.new_empty(3)
    if incomplete is None:
        incomplete = torch.empty(0, dtype=torch.bool, device=norms.device)
    launch(kernels.judge_step, 1, loss.detach(), norms, incomplete, verdict)
    return verdict[0], verdict[1], verdict[2]


@torch.no_grad()
def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    step: Tensor,
    skipped: Tensor,
    *,
    rate: Tensor | float,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """Changes parameter and moments in place, or nothing where `skipped` is 1: torch's step on the CPU, a kernel of the
    same numbers on a GPU, where torch's leaves most of it idle.

    parameter, gradient, first_moment, second_moment: contiguous float32 of one shape. step, skipped, rate: float32 of
    one element; step is the number of this step, from 1. All on one device, so that the call can be part of a CUDA
    graph; a rate that is a number cannot change there.
    Raises ValueError for a tensor that is not contiguous float32 of the parameter's shape.
    """
    shape = parameter.shape
    for name, tensor in {"gradient": gradient, "first moment": first_moment, "second moment": second_moment}.items():
        if tensor.shape != shape or tensor.dtype != torch.float32 or not tensor.is_contiguous():
            is_ = f"{tensor.dtype} {list(tensor.shape)}"
            raise ValueError(f"the {name} is {is_}, expected contiguous float32 {list(shape)}")
    if not parameter.numel():
        return
    if parameter.device.type == "cpu":
        lists = [parameter], [gradient], [first_moment], [second_moment], [], [step]
        numbers: Any = {"lr": float(rate), "beta1": betas[0], "beta2": betas[1], "weight_decay": 0.0, "eps": epsilon}
        torch._fused_adam_(*lists, **numbers, amsgrad=False, maximize=False, found_inf=skipped)  # pyright: ignore[reportPrivateImportUsage]
        return
    _step_by_kernel(parameter, gradient, first_moment, second_moment, step, skipped, rate, betas, epsilon)


def _step_by_kernel(parameter, gradient, first_moment, second_moment, step, skipped, rate, betas, epsilon) -> None:
    changed = parameter.view(-1), first_moment.view(-1), second_moment.view(-1)
    numbers = _numbers(step, rate, skipped, betas, epsilon)
    launch(kernels.update_by_adam, parameter.numel(), gradient.view(-1), *numbers, *changed)


@torch.no_grad()
def harmonics_adam_step(
    parameter: Tensor,
    start: int,
    gradients: HarmonicsGradients,
    first_moment: Tensor,
    second_moment: Tensor,
    step: Tensor,
    skipped: Tensor,
    *,
    rate: Tensor | float,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """adam_step() of coefficients of harmonics [N, K, 3] from number `start` on, whose gradients are multiplied out
    where they are used."""
    if not parameter.numel():
        return
    numbers = _numbers(step, rate, skipped, betas, epsilon)
    changed = parameter.view(-1), first_moment.view(-1), second_moment.view(-1)
    kernel = kernels.harmonics_adam_kernel(parameter.shape[1])
    launch(kernel, parameter.numel(), gradients.basis, gradients.by_values, start, *numbers, *changed)


def _numbers(step: Tensor, rate: Tensor | float, skipped: Tensor, betas: tuple[float, float], epsilon: float) -> tuple:
    """What Adam's kernels read beside gradient and state."""
    rate = rate if isinstance(rate, Tensor) else torch.full_like(skipped, rate)
    gains, logs = [1 - beta for beta in betas], [math.log(beta) for beta in betas]
    return step, rate, skipped, *gains, *logs, epsilon


@torch.no_grad()
def add_gradient_statistics(
    gradients: Tensor, radii: Tensor, usable: Tensor, width: int, height: int, gradient_sum: Tensor, seen: Tensor
) -> None:
    """Adds to gradient_sum [N] the lengths of gradients [N, 2] by the projected centres, in normalised screen units
    (the screen is 2 wide), and to seen [N] 1, where radii [N] are above 0; nothing where the scalar usable is 0. width,
    height: of the image in pixels. All float32 on one device."""
    given = gradients.contiguous(), radii, usable, width / 2, height / 2
    launch(kernels.add_gradient_statistics, len(radii), *given, gradient_sum, seen)


@torch.no_grad()
def add_position_noise(
    means: Tensor, log_scales: Tensor, quaternions: Tensor, opacity_logits: Tensor, *, strength: float, seed: int
) -> None:
    """Adds to means, in place, the noise of 3DGS-MCMC's equation 8: normal, shaped by each Gaussian's covariance, and
    faded out where opacities are above some hundredths.

    means, log_scales: [N, 3]; quaternions: [N, 4], any length; opacity_logits: [N]; all contiguous float32 on one
    device. strength: times the covariance, in world units the standard deviation; seed: of this call, an int32; the
    same one gives the same noise on every device and with any number of threads.
    """
    shapes = log_scales, quaternions, opacity_logits
    launch(kernels.add_position_noise, len(means), *shapes, seed, strength, means)
