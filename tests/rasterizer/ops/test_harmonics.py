"""Spherical harmonics against SciPy's and against finite differences."""

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from sehdr_warp.rasterizer import HarmonicsGradients, spherical_harmonics
from sehdr_warp.rasterizer.ops import harmonics
from sehdr_warp.rasterizer.ops.step_updates import AdamStep, adam_steps, harmonics_adam_step

from ..scenes import finite_differences, relative_error

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


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_adam_multiplies_the_factors_of_two_views_out(device, degree):
    coefficients, means, camera = (tensor.float().to(device) for tensor in inputs())
    positions = torch.stack([camera, -camera])
    by_values = torch.randn(2, 20, 3, generator=torch.Generator().manual_seed(1)).to(device)
    leaf = coefficients.clone().requires_grad_()
    sum(
        (spherical_harmonics(degree, leaf, means, p) * g).sum() for p, g in zip(positions, by_values, strict=True)
    ).backward()
    one, options = torch.ones((), device=device), {"rate": 0.01, "betas": (0.9, 0.999), "epsilon": 1e-15}
    for start, part in ((0, slice(0, 1)), (1, slice(1, 16))):
        plain, factored = (
            [t[:, part].clone(), *(torch.zeros_like(t[:, part]) for _ in range(2))] for t in [coefficients] * 2
        )
        gradient, decays = leaf.grad[:, part].contiguous(), {k: options[k] for k in ("betas", "epsilon")}
        adam_steps([AdamStep(plain[0], gradient, *plain[1:], one, options["rate"])], 0 * one, **decays)
        gradients = HarmonicsGradients(by_values, positions, means, degree)
        harmonics_adam_step(factored[0], start, gradients, *factored[1:], one, 0 * one, **options)
        for a, b in zip(plain, factored, strict=True):
            assert torch.allclose(a, b, rtol=1e-4, atol=1e-6)
        first_gradient = factored[0].clone()
        harmonics_adam_step(factored[0], start, gradients, *factored[1:], one, one, **options)
        assert torch.equal(first_gradient, factored[0])


@pytest.mark.parametrize("count", [60, 100])
def test_parts_of_the_coefficients_step_in_turn(device, count):
    generator = torch.Generator().manual_seed(1)
    start, by_values, means = (
        torch.randn(*shape, generator=generator).to(device) for shape in ((count, 15, 3), (1, count, 3), (count, 3))
    )
    gradients = HarmonicsGradients(by_values, torch.zeros(1, 3, device=device), means, 3)
    options = {"rate": 0.01, "betas": (0.9, 0.999), "epsilon": 1e-15}
    whole, parts = ([start.clone(), *(torch.zeros_like(start) for _ in range(2))] for _ in range(2))
    never, changed = torch.zeros((), device=device), []
    for number in (1.0, 2.0, 3.0, 4.0):
        before, step = parts[0].clone(), torch.tensor(number, device=device)
        harmonics_adam_step(parts[0], 1, gradients, *parts[1:], step, never, **options, update_interval=2)
        changed.append((parts[0] != before).view(-1))
    # Blocks take turns, whatever the number of Gaussians; two steps of each are those of all.
    second = torch.arange(count * 45, device=device) // 1024 % 2 == 1
    assert torch.equal(changed[0], second) and torch.equal(changed[1], ~second)
    assert torch.equal(changed[2], second) and torch.equal(changed[3], ~second)
    for number in (1.0, 2.0):
        step = torch.tensor(number, device=device)
        harmonics_adam_step(whole[0], 1, gradients, *whole[1:], step, never, **options)
    for a, b in zip(whole, parts, strict=True):
        assert torch.allclose(a, b, rtol=1e-5, atol=1e-7)
