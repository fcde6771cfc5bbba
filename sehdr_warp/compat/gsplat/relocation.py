"""gsplat's compute_relocation()."""

import torch
from torch import Tensor

from ...rasterizer.checks import check_shape, check_tensors
from ...rasterizer.ops.relocation import MOST_COPIES, relocation_sums


@torch.no_grad()
def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return opacities and sizes with which `ratios` Gaussians at one place look as one did.

    Equation 9 of 3DGS-MCMC (Kheradmand et al. 2024).

    Args:
        opacities: [N] in (0, 1).
        scales: [N, 3].
        ratios: [N], from 1; more than 51 or than the rows of binoms count as these.
        binoms: gsplat's table of binomials, of which only the number of rows counts.

    Raises:
        TypeError: for what is not a tensor.
        ValueError: for shapes, dtypes or devices that do not fit.
    """
    check_tensors(opacities=(opacities, ("N",)), scales=(scales, ("N", 3)))
    check_shape("ratios", ratios, opacities.shape)
    count = ratios.long().clamp(1, MOST_COPIES if binoms is None else min(MOST_COPIES, len(binoms)))
    shared = 1 - (1 - opacities.double()).pow(1 / count)
    powers = shared[:, None] ** torch.arange(1, MOST_COPIES + 1, device=opacities.device)
    denominators = (relocation_sums(opacities.device)[count - 1] * powers).sum(1)
    factors = (opacities.double() / denominators).to(scales.dtype)
    return shared.to(opacities.dtype), scales * factors[:, None]
