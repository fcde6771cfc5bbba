"""Spherical harmonics against SciPy's and against finite differences."""

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from sehdr_warp.rasterizer import HarmonicsGradients, spherical_harmonics
from sehdr_warp.rasterizer.ops import harmonics

from ..rasterizer.scenes import finite_differences, relative_error

GENERATOR_SEED = 7


def inputs(count=20, terms=16):
    generator = torch.Generator().manual_seed(GENERATOR_SEED)
    coefficients = torch.randn(count, terms, 3, generator=generator, dtype=torch.float64)
    means = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 2.0
    camera = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    return coefficients, means, camera


def real_harmonics(direction: np.ndarray) -> np.ndarray:
    """[N, 16] real spherical harmonics from SciPy's complex ones, with the signs that 3DGS gives them."""
    x, y, z = direction.T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            # SciPy's value carries the Condon-Shortley phase (-1)^m, and so do 3DGS's constants.
            if order == 0:
                columns.append(value.real)
            else:
                columns.append(np.sqrt(2) * (value.real if order > 0 else value.imag))
    return np.stack(columns, 1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_is_the_real_spherical_harmonics(device, degree):
    coefficients, means, camera = inputs()
    direction = torch.nn.functional.normalize(means - camera, dim=1).numpy()
    terms = (degree + 1) ** 2
    truth = torch.einsum("nk,nkc->nc", torch.from_numpy(real_harmonics(direction)[:, :terms]), coefficients[:, :terms])
    for dtype, bound in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        ours = spherical_harmonics(degree, *(t.to(device, dtype) for t in (coefficients, means, camera)))
        assert relative_error(ours, truth) < bound


@pytest.mark.parametrize("offset", [0.0, 1e-20, 1e25, float("inf")])
@pytest.mark.parametrize("with_jacobian", [False, True])
def test_a_mean_without_a_direction_has_the_constant_term_alone(device, offset, with_jacobian, monkeypatch):
    """At the camera, nearer than float32 can tell, and so far that squares overflow."""
    monkeypatch.setattr(harmonics, "writes_jacobian", lambda device: with_jacobian)
    coefficients, means, camera = (t.to(device, torch.float32) for t in inputs(2))
    means[0] = camera + torch.tensor([offset, 0.0, 0.0], device=device)
    leaves = [tensor.requires_grad_() for tensor in (coefficients, means, camera)]
    values = spherical_harmonics(3, *leaves)
    torch.testing.assert_close(values[0], coefficients[0, 0] * 0.28209479177387814)
    values.sum().backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves) and not means.grad[0].any() and means.grad[1].any()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("which", range(3), ids=["coefficients", "means", "camera_position"])
@pytest.mark.parametrize("with_jacobian", [False, True])
def test_gradients_match_finite_differences(device, degree, which, with_jacobian, monkeypatch):
    monkeypatch.setattr(harmonics, "writes_jacobian", lambda device: with_jacobian)
    tensors = inputs(count=6)
    weights = torch.randn(6, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(*arguments, dtype=torch.float64):
        values = spherical_harmonics(degree, *(t.to(device, dtype) for t in arguments))
        return (values * weights.to(device, dtype)).sum()

    numeric = finite_differences(loss, tensors, which, step=1e-3)
    for dtype, bound in ((torch.float64, 1e-8), (torch.float32, 1e-4)):
        leaves = [t.clone().requires_grad_() for t in tensors]
        loss(*leaves, dtype=dtype).backward()
        if degree == 0 and which > 0:
            assert not leaves[which].grad.any()
        else:
            assert relative_error(leaves[which].grad, numeric) < bound


def test_pair_of_coefficient_tensors_gives_the_same(device):
    coefficients, means, camera = (t.to(device) for t in inputs())
    pair = (coefficients[:, :1], coefficients[:, 1:])
    assert torch.equal(spherical_harmonics(2, pair, means, camera), spherical_harmonics(2, coefficients, means, camera))


def test_no_gaussians_have_gradients_of_their_shapes(device):
    leaves = [tensor.to(device).requires_grad_() for tensor in inputs(count=0)]
    spherical_harmonics(3, *leaves).sum().backward()
    assert [leaf.grad.shape for leaf in leaves] == [leaf.shape for leaf in leaves]
    assert not leaves[2].grad.any()


def test_one_gaussian_takes_joined_coefficients(device):
    """torch keeps the strides of axes of length 1; Warp refused gradients of other strides."""
    coefficients = torch.randn(1, 16, 3, device=device, requires_grad=True)
    means = torch.randn(1, 3, device=device, requires_grad=True)
    spherical_harmonics(3, coefficients, means, torch.zeros(3, device=device)).sum().backward()
    assert coefficients.grad.abs().sum() > 0 and means.grad.abs().sum() > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_thread_for_each_coefficient_gives_the_same(device, degree, dtype):
    leaves = [tensor.to(device, dtype).requires_grad_() for tensor in inputs()]
    weights = torch.randn(20, 3, generator=torch.Generator().manual_seed(1), dtype=dtype).to(device)
    spherical_harmonics(degree, *leaves).backward(weights)
    means, position = (leaf.detach() for leaf in leaves[1:])
    factors = HarmonicsGradients(weights[None], position[None], means, degree)
    rest_gradient = factors.coefficient_gradients(leaves[0].detach()[:, 1:].contiguous(), 1)
    assert torch.allclose(rest_gradient, leaves[0].grad[:, 1:], rtol=1e-5, atol=1e-6)
    assert not rest_gradient[:, (degree + 1) ** 2 - 1 :].any()
