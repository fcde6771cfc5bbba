"""View-dependent values from spherical harmonics."""

import torch

from ..kernels.harmonics import harmonics_adjoint_kernel, harmonics_kernel
from .launching import launch, warp_scalar

MAX_DEGREE = 3


def spherical_harmonics(degree: int, coefficients, means, camera_position):
    """Evaluate spherical harmonics for the direction from the camera to each Gaussian (3DGS's basis and signs).

    degree: 0 to 3, not above what the coefficients hold.
    coefficients: [N, K, 3] with K >= (degree + 1)^2, or the pair ([N, 1, 3], [N, K - 1, 3]) of the constant term and
        the rest, which saves joining them.
    means: [N, 3] world coordinates; camera_position: [3].

    Returns [N, 3]. Differentiable with respect to every tensor. Raises ValueError for a degree out of range, and for
    shapes, dtypes or devices that do not fit.
    """
    constant, rest = (
        (coefficients[:, :1], coefficients[:, 1:]) if isinstance(coefficients, torch.Tensor) else coefficients
    )
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics degree {degree} is not in 0..{MAX_DEGREE}")
    _check(constant, rest, means, camera_position)
    if rest.shape[1] < (degree + 1) ** 2 - 1:
        raise ValueError(f"degree {degree} needs {(degree + 1) ** 2} coefficients, not {1 + rest.shape[1]}")
    return _Evaluation.apply(degree, *(t.contiguous() for t in (constant, rest, means, camera_position)))


def _check(constant, rest, means, camera_position) -> None:
    count = means.shape[0] if means.ndim else 0
    shapes = {
        "means": (means, (count, 3)),
        "the constant coefficients": (constant, (count, 1, 3)),
        "the other coefficients": (rest, (count, rest.shape[1] if rest.ndim == 3 else 0, 3)),
        "camera_position": (camera_position, (3,)),
    }
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"shape {tuple(tensor.shape)} of {name}, expected {shape}")
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ValueError(f"{name}: {tensor.dtype} on {tensor.device}, but means is {means.dtype} on {means.device}")


class _Evaluation(torch.autograd.Function):
    """The adjoint is by hand: the generated one adds to zeros, number by number, which for 48 numbers a Gaussian takes
    several times as long as to write them."""

    @staticmethod
    def forward(ctx, degree, constant, rest, means, camera_position):
        ctx.degree = degree
        values = torch.empty_like(means)
        kernel = harmonics_kernel(warp_scalar(means.dtype), degree)
        launch(kernel, len(means), constant, rest, means, camera_position, values)
        ctx.save_for_backward(constant, rest, means, camera_position)
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        constant, *read = ctx.saved_tensors
        made = [torch.empty_like(tensor) for tensor in (constant, *read[:2])]
        kernel = harmonics_adjoint_kernel(warp_scalar(gradient.dtype), ctx.degree)
        launch(kernel, len(gradient), *read, gradient.contiguous(), *made)
        by_camera = -made[2].sum(0) if ctx.needs_input_grad[4] else None
        wanted = (part if needed else None for part, needed in zip(made, ctx.needs_input_grad[1:], strict=False))
        return None, *wanted, by_camera
