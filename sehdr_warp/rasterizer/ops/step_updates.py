"""Work of every training step beside rendering, on either device without waiting for it."""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...kernels import step_updates as kernels
from ..gradients import unit_gradient
from ..torch_contract import once_differentiable
from ..warp_launch.launching import launch
from ..warp_launch.threads import torch_threads
from .harmonics import HarmonicsGradients


class StepFlags(NamedTuple):
    """Two scalars, 1 or 0: whether a step is skipped, and whether it is applied."""

    skipped: Tensor
    applied: Tensor


@torch.no_grad()
def decide_step(
    loss: Tensor,
    finiteness: Tensor,
    overflow: Tensor | None = None,
    step_counters: Tensor | None = None,
    intersections: Tensor | None = None,
) -> StepFlags:
    """Decide whether a step is skipped: if its loss or a value of `finiteness` is not finite, or on overflow.

    Returns the decision, and counts it in step_counters.

    loss: float32 scalar. finiteness: [K] float32, finiteness_of() the gradients. overflow: bool scalar. step_counters:
    [3] int64, counts steps that are not finite; with intersections, an int64 scalar, it also holds the most
    intersections and counts the steps with overflow.
    """
    step_flags = finiteness.new_empty(2)
    launch(kernels.decide_step, 1, loss.detach(), finiteness, overflow, step_counters, intersections, step_flags)
    return StepFlags(*step_flags)


@torch.no_grad()
def finiteness_of(gradients: Sequence[Tensor]) -> Tensor:
    """Return [K] float32, all finite if all gradients and their squares are, which Adam's second moments take.

    On a CPU they are the norms of the gradients; on a GPU one number, 0 or infinity.
    """
    if gradients[0].device.type == "cuda":
        return nonfinite_by_kernel(gradients)
    with torch_threads(gradients[0].device):  # Threads change the last bits, but only finiteness counts.
        result = torch._foreach_norm(list(gradients))  # pyright: ignore[reportPrivateImportUsage]
    return torch.stack(result)


def nonfinite_by_kernel(gradients: Sequence[Tensor]) -> Tensor:
    """Do finiteness_of() by the kernel of a GPU, on either device."""
    result = gradients[0].new_zeros(1)
    flat = [gradient.reshape(-1) for gradient in gradients if gradient.numel()]
    for start in range(0, len(flat), kernels.TENSORS_PER_CHECK):
        group = flat[start : start + kernels.TENSORS_PER_CHECK]
        arguments = group + [None] * (kernels.TENSORS_PER_CHECK - len(group))
        launch(kernels.find_nonfinite, max(map(len, group)), *arguments, result)
    return result


def differentiate(loss: Tensor) -> None:
    """Call loss.backward() with a shared upstream 1; backward functions that recognize it skip the multiplication."""
    _ByOne.apply(loss).backward()


class _ByOne(torch.autograd.Function):
    @staticmethod
    def forward(ctx, loss):
        return loss.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return unit_gradient(upstream)


class AdamStep(NamedTuple):
    """One parameter's step of Adam; the first four are contiguous float32 of one shape."""

    parameter: Tensor
    gradient: Tensor
    first_moment: Tensor
    second_moment: Tensor
    step: Tensor  # float32 of one element, the number of this step, from 1
    rate: Tensor | float  # float32 of one element, or a number, which cannot change in a CUDA graph
    width: int = 0  # Numbers in a Gaussian's row if adam_steps() gets `active_count`; else 0


@torch.no_grad()
def adam_steps(
    steps: Sequence[AdamStep],
    skipped: Tensor,
    *,
    betas: tuple[float, float],
    epsilon: float,
    active_count: Tensor | None = None,
) -> None:
    """Update parameters and moments by Adam in place; nothing if `skipped`, float32 of one element, is 1.

    By torch on the CPU. On a GPU, most of which torch's update leaves idle, by a kernel of the same numbers, several
    parameters at once. Nothing waits for the device, so the call can be part of a CUDA graph.

    active_count: [1] int32, how many rows count; the gradients of others are 0.

    Raises:
        ValueError: if a tensor is not contiguous float32 of the parameter's shape.
    """
    for each in steps:
        shape = each.parameter.shape
        for name in ("gradient", "first_moment", "second_moment"):
            tensor: Tensor = getattr(each, name)
            if tensor.shape != shape or tensor.dtype != torch.float32 or not tensor.is_contiguous():
                actual = f"{tensor.dtype} {list(tensor.shape)}"
                raise ValueError(f"the {name.replace('_', ' ')} is {actual}, expected contiguous float32 {list(shape)}")
    steps = [step for step in steps if step.parameter.numel()]
    if skipped.device.type == "cuda":
        steps_by_kernel(steps, skipped, betas, epsilon, active_count)
        return
    numbers: Any = {"beta1": betas[0], "beta2": betas[1], "weight_decay": 0.0, "eps": epsilon, "found_inf": skipped}
    numbers |= {"amsgrad": False, "maximize": False}
    with torch_threads(skipped.device):
        for parameter, gradient, first_moment, second_moment, step, rate, _ in steps:
            lists = [parameter], [gradient], [first_moment], [second_moment], [], [step]
            torch._fused_adam_(*lists, lr=float(rate), **numbers)  # pyright: ignore[reportPrivateImportUsage]


def steps_by_kernel(steps: Sequence[AdamStep], skipped, betas, epsilon, active_count=None) -> None:
    """Do adam_steps() by the kernel of a GPU, on either device."""
    for start in range(0, len(steps), kernels.PARAMETERS_PER_LAUNCH):
        group = steps[start : start + kernels.PARAMETERS_PER_LAUNCH]
        absent = kernels.PARAMETERS_PER_LAUNCH - len(group)
        arguments = [*(step.width for step in group), *[0] * absent, _adam_numbers(betas, epsilon)]
        for parameter, gradient, first_moment, second_moment, step, rate, _ in group:
            flat = (tensor.view(-1) for tensor in (parameter, first_moment, second_moment))
            arguments += [gradient.view(-1), step.view(1), _rate(rate, skipped).view(1), *flat]
        arguments += [None] * (6 * absent)
        most = max(step.parameter.numel() for step in group)
        launch(kernels.update_by_adam, most, skipped.view(1), active_count, *arguments)


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
    active_count: Tensor | None = None,
    update_interval: int = 1,
) -> None:
    """Do adam_steps() for coefficients of harmonics [N, K, 3] from number `start` on.

    Their gradients are multiplied out as they are used. update_interval: parts of the coefficients that are updated in
    turn, one at each call; `step` tells whose turn it is and how many it had.
    """
    if not parameter.numel():
        return
    options = step, _rate(rate, skipped), skipped, active_count, _adam_numbers(betas, epsilon)
    values = parameter.view(-1), first_moment.view(-1), second_moment.view(-1)
    kernel = kernels.harmonics_adam_kernel(parameter.shape[1])
    in_turn = parameter.numel()
    if update_interval > 1:
        in_turn = -(-in_turn // (kernels.SH_BLOCK * update_interval)) * kernels.SH_BLOCK
    stride = -(-in_turn // kernels.VALUES_PER_THREAD)
    arguments = gradients.basis, gradients.grad_colors, start, stride, update_interval, *options, *values
    launch(kernel, stride, *arguments)


def _rate(rate: Tensor | float, like: Tensor) -> Tensor:
    return rate if isinstance(rate, Tensor) else torch.full_like(like, rate)


@cache
def _adam_numbers(betas: tuple[float, float], epsilon: float) -> Any:
    first, second = betas
    return kernels.AdamNumbers(1 - first, 1 - second, math.log(first), math.log(second), epsilon)


@torch.no_grad()
def add_gradient_statistics(
    gradients: Tensor, radii: Tensor, usable: Tensor, width: int, height: int, gradient_sum: Tensor, photo_count: Tensor
) -> None:
    """Add the lengths of gradients [N, 2] of projected centers to gradient_sum [N], and 1 to photo_count [N].

    Lengths are in normalized screen units (the screen is 2 wide). Only Gaussians with radii [N] above 0 count, and
    nothing is added if the scalar usable is 0. width, height: of the image in pixels. All float32 on one device.
    """
    inputs = gradients.contiguous(), radii, usable, width / 2, height / 2
    launch(kernels.add_gradient_statistics, len(radii), *inputs, gradient_sum, photo_count)


@torch.no_grad()
def add_position_noise(
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacity_logits: Tensor,
    *,
    strength: float,
    seed: int,
    most_sizes: float = math.inf,
    most_distance: float = math.inf,
) -> None:
    """Add the position noise of 3DGS-MCMC (equation 8) to the means, in place.

    The noise is normal, shaped by each Gaussian's covariance, and fades out for opacities above a few hundredths. Two
    departures keep it bounded in scenes with far or large Gaussians: outside of the unit ball the strength falls with
    the distance from the origin, so that it depends on the angle that a Gaussian covers, and a step is bounded by
    the Gaussian's own size. The same seed gives the same noise on every device and with any number of threads.

    Args:
        means: [N, 3] normalized coordinates; this and the next three are contiguous float32 on one device.
        log_scales: [N, 3] natural logarithms of standard deviations.
        quaternions: [N, 4] (w, x, y, z) of any length.
        opacity_logits: [N].
        strength: factor of the covariance that gives the standard deviation of the noise.
        seed: int32, of this call.
        most_sizes: bound on the standard deviation of the noise along an axis, in standard deviations of the Gaussian.
        most_distance: noise moves no Gaussian beyond this distance from the origin.
    """
    shapes = log_scales, quaternions, opacity_logits
    launch(kernels.add_position_noise, len(means), *shapes, seed, strength, most_sizes, most_distance, means)
