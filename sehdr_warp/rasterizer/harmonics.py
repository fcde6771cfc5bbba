"""View-dependent values from spherical harmonics."""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels.harmonics import (
    basis_kernel,
    channels_kernel,
    coefficient_adjoint_kernel,
    harmonics_adjoint_kernel,
    harmonics_kernel,
    turns_adjoint_kernel,
)
from .checks import check_tensors, integer
from .torch_contract import torch_operation
from .warp_launch.launching import launch, warp_scalar

MAX_DEGREE = 3


@partial(torch_operation, compiles=True)
def spherical_harmonics(
    degree: int, coefficients: Tensor | tuple[Tensor, Tensor], means: Tensor, camera_position: Tensor
) -> Tensor:
    """Evaluate spherical harmonics for the direction from the camera to each Gaussian (3DGS's basis and signs).

    Args:
        degree: 0 to 3, not above what the coefficients hold.
        coefficients: [N, K, 3] with K >= (degree + 1)^2, or the pair ([N, 1, 3], [N, K - 1, 3]) of the constant term
            and the rest, which saves joining them.
        means: [N, 3] world coordinates.
        camera_position: [3].

    Returns:
        [N, 3], differentiable with respect to every tensor.

    Raises:
        TypeError: for what is no tensor.
        ValueError: for a degree out of range, and for shapes, dtypes or devices that do not fit.
    """
    degree, constant, rest = check_harmonics(degree, coefficients, means, camera_position)
    return _Evaluation.apply(degree, *(t.contiguous() for t in (constant, rest, means, camera_position)))


class Coefficients(NamedTuple):
    """The degree as an integer, and coefficients in two parts."""

    degree: int
    constant: Tensor
    rest: Tensor


def check_harmonics(degree: int, coefficients: Any, means: Any, camera_position: Any) -> Coefficients:
    """Return the coefficients of spherical_harmonics(), or raise what it does for arguments that do not fit."""
    arguments: dict[str, Any] = {"means": (means, ("N", 3))}
    if isinstance(coefficients, tuple | list) and len(coefficients) == 2:
        arguments |= {
            "coefficients[0]": (coefficients[0], ("N", 1, 3)),
            "coefficients[1]": (coefficients[1], ("N", "K", 3)),
        }
    else:
        arguments |= {"coefficients": (coefficients, ("N", "K", 3))}
    check_tensors(**arguments, camera_position=(camera_position, (3,)))
    degree = integer("degree", degree, 0, MAX_DEGREE)
    whole = isinstance(coefficients, Tensor)
    constant, rest = (coefficients[:, :1], coefficients[:, 1:]) if whole else coefficients
    if constant.shape[1] + rest.shape[1] < (degree + 1) ** 2:
        raise ValueError(f"degree {degree} needs {(degree + 1) ** 2} coefficients, not {1 + rest.shape[1]}")
    return Coefficients(degree, constant, rest)


@dataclass(frozen=True)
class HarmonicsGradients:
    """Gradients by coefficients of harmonics as their factors: 3 numbers for a Gaussian and view in place of 48.

    The gradients are sums over the views.

    Attributes:
        by_values: [V, N, 3] gradients by the values of each view.
        positions: [V, 3] of the views' cameras, world coordinates.
        means: [N, 3] of the Gaussians when the views were rendered.
        degree: of the evaluation.
    """

    by_values: Tensor
    positions: Tensor
    means: Tensor
    degree: int

    @cached_property
    def basis(self) -> Tensor:
        """[V, (degree + 1)^2, N] the harmonics towards each mean, as the means are at the first call."""
        means = self.means.detach()
        basis = means.new_empty(len(self.positions), (self.degree + 1) ** 2, len(means))
        kernel = basis_kernel(warp_scalar(means.dtype), self.degree)
        launch(kernel, len(self.positions) * len(means), means, self.positions, basis)
        return basis

    def by_coefficients(self, like: Tensor, start: int) -> Tensor:
        """Return the gradients [N, K, 3], like a tensor of that shape, by the coefficients from number `start` on."""
        gradients = torch.empty_like(like)
        if gradients.numel():
            kernel = coefficient_adjoint_kernel(warp_scalar(gradients.dtype), gradients.shape[1])
            launch(kernel, gradients.numel(), self.basis, self.by_values, start, gradients.view(-1))
        return gradients


class _Evaluation(torch.autograd.Function):
    """Harmonics with an adjoint written by hand.

    The generated adjoint adds to zeros, number by number, which for 48 numbers a Gaussian takes several times as long
    as writing them.
    """

    @staticmethod
    def forward(ctx, degree, constant, rest, means, camera_position):
        scalar, inputs, values = (
            warp_scalar(means.dtype),
            (constant, rest, means, camera_position),
            torch.empty_like(means),
        )
        # A GPU waits for memory: what the backward pass needs of 48 numbers a Gaussian are 9, made while they are here.
        turning = writes_turns(means.device) and any(ctx.needs_input_grad[3:])
        turns = means.new_empty(len(means) if turning else 0, 3, 3)
        if writes_turns(means.device):
            launch(channels_kernel(scalar, degree, turning), 3 * len(means), *inputs, values, turns)
        else:
            launch(harmonics_kernel(scalar, degree), len(means), *inputs, values)
        ctx.degree, ctx.turning = degree, turning
        ctx.save_for_backward(constant, rest, means, camera_position, turns)
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        constant, rest, means, position, turns = ctx.saved_tensors
        scalar, degree, gradient = warp_scalar(gradient.dtype), ctx.degree, gradient.contiguous()
        by_constant, by_rest, by_means, by_camera = ctx.needs_input_grad[1:]
        # On the CPU a thread takes a Gaussian with all of its coefficients.
        together = not writes_turns(gradient.device) and (by_constant or by_rest)
        by_parts = [torch.empty_like(part) if together else None for part in (constant, rest)]
        mean_gradients = torch.empty_like(means)
        if ctx.turning:
            launch(turns_adjoint_kernel(scalar), len(means), turns, gradient, mean_gradients)
        elif by_means or by_camera or together:
            kernel = harmonics_adjoint_kernel(scalar, degree, together)
            launch(kernel, len(means), rest, means, position, gradient, mean_gradients, *by_parts)
        if not together and (by_constant or by_rest):
            factors = HarmonicsGradients(gradient[None], position[None], means, degree)
            by_parts = [factors.by_coefficients(part, start) for start, part in enumerate((constant, rest))]
        by_position = -mean_gradients.sum(0) if by_camera else None
        return None, *by_parts, mean_gradients if by_means else None, by_position


def writes_turns(device: torch.device) -> bool:
    """Return whether the forward pass on a device has one thread for each channel.

    That pass also writes what the gradient by the means needs.
    """
    return device.type == "cuda"
