"""View-dependent values from spherical harmonics."""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...kernels.harmonics import (
    basis_kernel,
    channels_kernel,
    coefficient_backward_kernel,
    harmonics_backward_kernel,
    harmonics_kernel,
    jacobian_backward_kernel,
)
from ..checks import check_memory, check_tensors, integer
from ..torch_contract import once_differentiable, torch_operation
from ..warp_launch.launching import launch, warp_scalar

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
        TypeError: for what is not a tensor.
        ValueError: for a degree out of range, and for shapes, dtypes or devices that do not fit.
    """
    degree, constant, rest = check_harmonics(degree, coefficients, means, camera_position)
    check_memory(coefficients=constant, means=means)
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
    """Gradients of harmonics' coefficients as their factors: 3 numbers for a Gaussian and view in place of 48.

    The gradients are sums over the views. In a training on a GPU, RadianceField.render_photo() hooks grad_colors,
    FlatGradients joins the ranks' views, and Adam.step() multiplies the factors out in its kernel
    (harmonics_adam_step), so that the gradients of the coefficients are never stored.
    """

    grad_colors: Tensor  # [V, N, 3] gradients with respect to the values of each view
    positions: Tensor  # [V, 3] of the views' cameras, world coordinates
    means: Tensor  # [N, 3] of the Gaussians when the views were rendered
    degree: int  # Of the evaluation

    @cached_property
    def basis(self) -> Tensor:
        """Return the harmonics towards each mean, [V, (degree + 1)^2, N], as the means are at the first call."""
        means = self.means.detach()
        basis = means.new_empty(len(self.positions), (self.degree + 1) ** 2, len(means))
        kernel = basis_kernel(warp_scalar(means.dtype), self.degree)
        launch(kernel, len(self.positions) * len(means), means, self.positions, basis)
        return basis

    def coefficient_gradients(self, like: Tensor, start: int) -> Tensor:
        """Return the gradients of the coefficients from number `start` on, like a tensor [N, K, 3]."""
        gradients = torch.empty_like(like)
        if gradients.numel():
            kernel = coefficient_backward_kernel(warp_scalar(gradients.dtype), gradients.shape[1])
            launch(kernel, gradients.numel(), self.basis, self.grad_colors, start, gradients.view(-1))
        return gradients


class _Evaluation(torch.autograd.Function):
    """Harmonics with a backward pass written by hand.

    The generated adjoint adds to zeros, number by number, which for 48 numbers a Gaussian takes several times as long
    as writing them.
    """

    @staticmethod
    def forward(ctx, degree, constant, rest, means, camera_position):
        scalar, values = warp_scalar(means.dtype), torch.empty_like(means)
        inputs = constant, rest, means, camera_position
        # A GPU is bound by memory: with a stored 3 x 3 Jacobian the backward pass need not read 48 coefficients again.
        with_jacobian = writes_jacobian(means.device) and any(ctx.needs_input_grad[3:])
        mean_jacobian = means.new_empty(len(means) if with_jacobian else 0, 3, 3)
        if writes_jacobian(means.device):
            launch(channels_kernel(scalar, degree, with_jacobian), 3 * len(means), *inputs, values, mean_jacobian)
        else:
            launch(harmonics_kernel(scalar, degree), len(means), *inputs, values)
        ctx.degree, ctx.with_jacobian = degree, with_jacobian
        ctx.save_for_backward(constant, rest, means, camera_position, mean_jacobian)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        constant, rest, means, position, mean_jacobian = ctx.saved_tensors
        scalar, degree, gradient = warp_scalar(gradient.dtype), ctx.degree, gradient.contiguous()
        need_constant, need_rest, need_means, need_camera = ctx.needs_input_grad[1:]
        # On the CPU a thread takes a Gaussian with all of its coefficients.
        together = not writes_jacobian(gradient.device) and (need_constant or need_rest)
        grad_parts = [torch.empty_like(part) if together else None for part in (constant, rest)]
        grad_means = torch.empty_like(means)
        if ctx.with_jacobian:
            launch(jacobian_backward_kernel(scalar), len(means), mean_jacobian, gradient, grad_means)
        elif need_means or need_camera or together:
            kernel = harmonics_backward_kernel(scalar, degree, together)
            launch(kernel, len(means), rest, means, position, gradient, grad_means, *grad_parts)
        if not together and (need_constant or need_rest):
            factors = HarmonicsGradients(gradient[None], position[None], means, degree)
            grad_parts = [factors.coefficient_gradients(part, start) for start, part in enumerate((constant, rest))]
        grad_position = -grad_means.sum(0) if need_camera else None
        return None, *grad_parts, grad_means if need_means else None, grad_position


def writes_jacobian(device: torch.device) -> bool:
    """Return whether the forward pass on a device has one thread for each channel.

    That pass also writes what the gradient with respect to the means needs.
    """
    return device.type == "cuda"
