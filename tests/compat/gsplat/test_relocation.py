"""Relocated Gaussians."""

import math

import pytest
import torch

from sehdr_warp.compat.gsplat import compute_relocation


def test_relocated_gaussians_look_as_the_one_did():
    """Equation 9: n Gaussians one behind another have the opacity of the one, and its integral over a line."""
    opacities, scales = torch.tensor([0.3, 0.9, 0.6]), torch.ones(3, 3)
    ratios = torch.tensor([1, 2, 5])
    shared, sizes = compute_relocation(opacities, scales, ratios)
    fewer, _ = compute_relocation(opacities, scales, ratios, torch.zeros(2, 2))
    assert torch.equal(fewer[:2], shared[:2]) and float(fewer[2]) == pytest.approx(1 - math.sqrt(0.4))
    torch.testing.assert_close(1 - (1 - shared) ** ratios, opacities)
    assert float(sizes[0, 0]) == pytest.approx(1.0)
    x = torch.linspace(-12, 12, 20001, dtype=torch.float64)
    for opacity, own, size, ratio in zip(opacities, shared, sizes[:, 0], ratios, strict=True):
        one = (opacity * torch.exp(-(x**2) / 2)).sum()
        alpha = own.double() * torch.exp(-((x / size.double()) ** 2) / 2)
        together = (1 - (1 - alpha) ** int(ratio)).sum()
        assert float(together / one) == pytest.approx(1, rel=1e-4)
