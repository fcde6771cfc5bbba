"""View-dependent values from spherical harmonics."""

import torch

from ..kernels.geometry import vector
from ..kernels.harmonics import harmonics_adjoint_kernel, harmonics_kernel
from . import threads
from .arrays import view, warp_scalar
from .bridge import differentiable

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
    return _evaluate(
        constant.contiguous(), rest.contiguous(), means.contiguous(), camera_position.contiguous(), degree=degree
    )


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


@differentiable
def _evaluate(program, constant, rest, means, camera_position, *, degree):
    scalar = warp_scalar(means.dtype)
    vec3 = vector(3, scalar)
    gradients = [program.hand_over(tensor) for tensor in (constant, rest, means, camera_position)]
    values = program.write(means.shape, vec3)
    rest3, means3, camera3 = (program.read(tensor, vec3) for tensor in (rest, means, camera_position))
    kernel = harmonics_kernel(scalar, degree)
    arguments = [program.read(constant, vec3), rest3, means3, camera3]
    program.launch_ranges(kernel, means.shape[0], arguments, [values], recorded=False)

    device, is_cpu = program.device, program.is_cpu  # the tape holds the adjoint, which must not hold the program

    def adjoint():
        """By hand: the generated one adds to zeros, number by number, which for 48 numbers a Gaussian takes several
        times as long as to write them."""
        made = [torch.empty_like(tensor) for tensor in (constant, rest, means)]
        threads.launch_ranges(
            harmonics_adjoint_kernel(scalar, degree),
            threads.even_ranges(len(means)) if is_cpu else [(0, len(means))],
            [rest3, means3, camera3, values.grad, *(view(tensor, vec3) for tensor in made)],
            device,
        )
        for gradient, value in zip(gradients, made, strict=False):
            gradient.value = value if gradient.wanted else None
        if gradients[3].wanted:
            gradients[3].value = -made[2].sum(0)

    program.record_adjoint(adjoint)
    return values
