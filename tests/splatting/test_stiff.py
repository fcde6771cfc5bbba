"""What the catalogue of stiff cases (sehdr_warp.check) and the fuzzing of the operations have found, once each."""

import torch

from sehdr_warp.splatting import rasterize, spherical_harmonics
from sehdr_warp.splatting.reference import rasterize_reference

from .scenes import random_scene, relative_error


def test_one_gaussian_takes_joined_coefficients(device):
    """torch keeps the strides of axes of length 1; Warp refused gradients of other strides."""
    coefficients = torch.randn(1, 16, 3, device=device, requires_grad=True)
    means = torch.randn(1, 3, device=device, requires_grad=True)
    spherical_harmonics(3, coefficients, means, torch.zeros(3, device=device)).sum().backward()
    assert coefficients.grad.abs().sum() > 0 and means.grad.abs().sum() > 0


def test_harmonics_at_the_camera_have_finite_gradients(device):
    coefficients = torch.randn(2, 16, 3, device=device, requires_grad=True)
    means = torch.tensor([[1.0, 2.0, 3.0], [0.5, 0.5, 0.5]], device=device, requires_grad=True)
    position = torch.full((3,), 0.5, device=device, requires_grad=True)
    spherical_harmonics(3, coefficients, means, position).sum().backward()
    assert torch.isfinite(means.grad).all() and torch.isfinite(position.grad).all()
    assert (means.grad[1] == 0).all() and (means.grad[0] != 0).any()


def test_many_faint_gaussians_keep_their_gradients(device):
    """10^4 factors of 1 - 1e-4 lost three digits of every gradient while the adjoint divided by them one by one."""
    scene = random_scene(count=10_000, channels=1, width=3, height=2, spread=0.1)
    scene.tensors[1][:] = 0.0
    scene.tensors[3][:] = 1e-4
    scene.tensors[0][:, 2] = torch.linspace(2.0, 6.0, 10_000, dtype=torch.float64)
    ours, truth = scene.to(torch.float32, device), scene.to(torch.float32).to(torch.float64)
    rasterize(*ours.arguments, alpha_threshold=1e-6).image.sum().backward()
    rasterize_reference(*truth.arguments, alpha_threshold=1e-6).image.sum().backward()
    for which in (3, 4):
        assert relative_error(ours.tensors[which].grad, truth.tensors[which].grad) < 2e-5
