"""gsplat's spherical_harmonics()."""

import torch
from torch import Tensor

from ...rasterizer import spherical_harmonics as evaluate
from ...rasterizer.checks import check_shape, check_tensors, integer
from ...rasterizer.ops.harmonics import MAX_DEGREE


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Evaluate spherical harmonics along directions.

    Args:
        degrees_to_use: 0 to 3.
        dirs: [..., 3], of any length.
        coeffs: [..., K, 3] with K >= (degrees_to_use + 1)^2.
        masks: [...] bool, where values are wanted; elsewhere they are 0.

    Returns:
        [..., 3].

    Raises:
        TypeError: for what is not a tensor.
        ValueError: for a degree above 3, and for shapes, dtypes or devices that do not fit.
    """
    check_degree("degrees_to_use", degrees_to_use)
    batch = tuple(dirs.shape[:-1]) if isinstance(dirs, Tensor) else ()
    check_tensors(dirs=(dirs, (*batch, 3)), coeffs=(coeffs, (*batch, "K", 3)))
    if masks is not None:
        check_shape("masks", masks, batch)
    shape = dirs.shape
    origin = dirs.new_zeros(3)
    values = evaluate(degrees_to_use, coeffs.reshape(-1, *coeffs.shape[-2:]), dirs.reshape(-1, 3), origin)
    values = values.reshape(shape)
    return values if masks is None else torch.where(masks[..., None], values, 0.0)


def check_degree(name: str, degree: int) -> None:
    """Raise TypeError or ValueError for what is not a degree, and for one that gsplat has and the rasterizer does not.

    gsplat's own are 0 to 4.
    """
    if integer(name, degree, 0, 4) > MAX_DEGREE:
        raise ValueError(f"{name} {degree} is not supported, expected 0 to {MAX_DEGREE}")
