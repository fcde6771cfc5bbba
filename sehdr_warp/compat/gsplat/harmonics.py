"""Spherical harmonics with gsplat's arguments, up to its degree 4."""

import math

import torch
from torch import Tensor

from ...rasterizer import spherical_harmonics as evaluate_lower
from ...rasterizer.checks import check_shape, check_tensors, integer
from ...rasterizer.ops.harmonics import MAX_DEGREE
from ...rasterizer.torch_contract import torch_operation

HIGHEST_DEGREE = 4


@torch_operation
def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Evaluate spherical harmonics along directions.

    Args:
        degrees_to_use: 0 to 4.
        dirs: [..., 3], of any length.
        coeffs: [..., K, 3] with K >= (degrees_to_use + 1)^2.
        masks: [...] bool, where values are wanted; elsewhere they are 0.

    Returns:
        [..., 3].

    Raises:
        TypeError: for what is not a tensor.
        ValueError: for another degree, and for shapes, dtypes or devices that do not fit.
    """
    degree = integer("degrees_to_use", degrees_to_use, 0, HIGHEST_DEGREE)
    batch = tuple(dirs.shape[:-1]) if isinstance(dirs, Tensor) else ()
    check_tensors(dirs=(dirs, (*batch, 3)), coeffs=(coeffs, (*batch, "K", 3)))
    check_count("coeffs", coeffs, "degrees_to_use", degree)
    if masks is not None:
        check_shape("masks", masks, batch)
    shape = dirs.shape
    values = evaluate(degree, coeffs.reshape(-1, *coeffs.shape[-2:]), dirs.reshape(-1, 3), dirs.new_zeros(3))
    values = values.reshape(shape)
    return values if masks is None else torch.where(masks[..., None], values, 0.0)


def check_count(name: str, coefficients: Tensor, degree_name: str, degree: int) -> None:
    """Raise ValueError if there are fewer coefficients [..., K, 3] than a degree has."""
    if coefficients.shape[-2] < (degree + 1) ** 2:
        raise ValueError(
            f"{name} has shape {list(coefficients.shape)}, but {degree_name} {degree} needs {(degree + 1) ** 2} "
            "coefficients"
        )


def evaluate(degree: int, coefficients: Tensor, means: Tensor, position: Tensor) -> Tensor:
    """Return [N, 3] of coefficients [N, K, 3], as means [N, 3] are seen from a position [3].

    The kernel has the degrees up to 3, torch's operations the fourth.
    """
    values = evaluate_lower(min(degree, MAX_DEGREE), coefficients, means, position)
    return values if degree <= MAX_DEGREE else values + _fourth_band(coefficients[:, 16:25], means - position)


def _fourth_band(coefficients: Tensor, directions: Tensor) -> Tensor:
    """Return [N, 3] of the nine coefficients of degree 4; NaN, without a gradient, for what is not finite."""
    finite = coefficients.isfinite().all(2).all(1) & directions.isfinite().all(1)
    x, y, z = torch.nn.functional.normalize(torch.where(finite[:, None], directions, 1.0), dim=1).unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    basis = (
        2.5033429417967046 * x * y * (xx - yy),
        -1.7701307697799304 * y * z * (3 * xx - yy),
        0.9461746957575601 * x * y * (7 * zz - 1),
        -0.6690465435572892 * y * z * (7 * zz - 3),
        0.10578554691520431 * (zz * (35 * zz - 30) + 3),
        -0.6690465435572892 * x * z * (7 * zz - 3),
        0.47308734787878004 * (xx - yy) * (7 * zz - 1),
        -1.7701307697799304 * x * z * (xx - 3 * yy),
        0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
    )
    values = (torch.stack(basis, 1)[:, :, None] * torch.where(finite[:, None, None], coefficients, 0.0)).sum(1)
    return torch.where(finite[:, None], values, math.nan)
