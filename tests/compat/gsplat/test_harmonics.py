"""gsplat's spherical harmonics beside their formulas."""

import math

import numpy as np
import pytest
import torch

from sehdr_warp.compat import gsplat
from sehdr_warp.splats.arrays import harmonic_basis

from .scenes import COUNT, gradients, scene


def basis(unit, degree):
    """The project's basis, and degree 4 by derivatives of a Legendre polynomial."""
    lower, legendre = harmonic_basis(unit, min(degree, 3)), np.polynomial.legendre.Legendre.basis(4)
    plane, bands = unit[..., 0] + 1j * unit[..., 1], []
    for order in range(-4, 5) if degree == 4 else ():
        m = abs(order)
        norm = (-1) ** m * math.sqrt(9 / (4 * math.pi) * math.factorial(4 - m) / math.factorial(4 + m))
        around = math.sqrt(2 if m else 1) * (plane**m if order >= 0 else -1j * plane**m).real
        bands.append(norm * legendre.deriv(m)(unit[..., 2]) * around)
    return np.concatenate([lower, np.stack(bands, -1)], -1) if bands else lower


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_harmonics_are_evaluated_along_directions_of_any_length(degree):
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    coefficients = torch.randn(2, 5, 25, 3, generator=generator, dtype=torch.float64)
    masks = torch.rand(2, 5, generator=generator) < 0.5
    values = gsplat.spherical_harmonics(degree, 7 * directions, coefficients, masks)
    unit = torch.nn.functional.normalize(directions, dim=-1).numpy()
    expected = np.einsum("...k,...kc->...c", basis(unit, degree), coefficients[:, :, : (degree + 1) ** 2])
    torch.testing.assert_close(values, torch.tensor(expected) * masks[..., None])


def test_colors_of_degree_4_have_gradients_and_what_is_not_finite_is_culled(device):
    leaves, place = scene(device, coefficients=25)
    leaves = [leaf.detach().double() for leaf in leaves]
    place = place._replace(viewmats=place.viewmats[:1].double(), Ks=place.Ks[:1].double())
    means, coefficients = leaves[0][:3].clone().requires_grad_(), leaves[4][:3].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda *inputs: gsplat.spherical_harmonics(4, *inputs), (means, coefficients))
    bad = [leaf.clone() for leaf in leaves]
    bad[4][:3, 20], bad[4][3:5, 2] = float("nan"), -float("inf")
    bad, good = [t.requires_grad_() for t in bad], [leaf[5:].requires_grad_() for leaf in leaves]
    place.viewmats.requires_grad_()
    image, _, _ = gsplat.rasterization(*bad, **place._asdict(), sh_degree=4)
    same, _, _ = gsplat.rasterization(*good, **place._asdict(), sh_degree=4)
    direct = gsplat.spherical_harmonics(4, good[0] - torch.linalg.inv(place.viewmats)[0, :3, 3], good[4])
    plain, _, _ = gsplat.rasterization(*good[:4], (direct + 0.5).clamp_min(0), **place._asdict())
    torch.testing.assert_close(image, same)
    torch.testing.assert_close(image, plain)
    for mine, its in zip(
        gradients(image, [*bad, place.viewmats]), gradients(plain, [*good, place.viewmats]), strict=True
    ):
        torch.testing.assert_close(mine[5:] if len(mine) == COUNT else mine, its, rtol=1e-6, atol=1e-9)
        assert len(mine) != COUNT or not mine[:5].any()


def test_misfits_of_coefficients_are_named():
    ones = torch.ones(3, 3), torch.ones(3, 4, 3)
    for arguments, message in (
        ((1, torch.ones(3, 3), torch.ones(2, 4, 3)), r"coeffs has shape \[2, 4, 3\]"),
        ((1, torch.ones(3, 2), torch.ones(3, 4, 3)), r"dirs has shape \[3, 2\]"),
        (("1", *ones), "degrees_to_use is '1', expected a whole number"),
        ((5, *ones), r"degrees_to_use 5 is not in 0\.\.4"),
        ((4, *ones), r"coeffs has shape \[3, 4, 3\], but degrees_to_use 4 needs 25 coefficients"),
        ((1, *ones, [True] * 3), "masks is a list"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            gsplat.spherical_harmonics(*arguments)


def test_autocast_lowers_no_precision():
    generator = torch.Generator().manual_seed(0)
    directions, coefficients = (torch.randn(5, *shape, generator=generator) for shape in ((3,), (25, 3)))
    quats, scales = torch.randn(5, 4, generator=generator), torch.rand(5, 3, generator=generator)
    values = gsplat.spherical_harmonics(4, directions, coefficients.bfloat16().float())
    covars = gsplat.quat_scale_to_covar_preci(quats, scales)[0]
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(gsplat.spherical_harmonics(4, directions, coefficients.bfloat16()), values)
        assert torch.equal(gsplat.quat_scale_to_covar_preci(quats, scales)[0], covars)
