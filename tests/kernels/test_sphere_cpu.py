"""Rows of pixels of the sphere's blend on the CPU, where neighbors look in any directions; see test_sphere.py too."""

import numpy as np
import pytest
import torch

from sehdr_warp.rasterizer import rasterize_directions

from ..rasterizer.scenes import finite_differences, random_like, relative_error
from .test_sphere import FOCAL, gaussians, latlong, reference


def scattered(height: int, width: int) -> torch.Tensor:
    """Unit vectors [H, W, 3] of which no neighbors are near each other."""
    values = np.random.default_rng(5).normal(size=(height, width, 3))
    return torch.tensor(values / np.linalg.norm(values, axis=2, keepdims=True))


@pytest.mark.parametrize("shape", [(1, 1), (7, 9), (16, 8), (19, 21), (33, 40)])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 3e-4)])
def test_scattered_directions_show_what_single_ones_do(shape, dtype, tolerance):
    scene, directions = gaussians(dtype=dtype), scattered(*shape)
    image, left = rasterize_directions(
        *scene, torch.zeros(3, dtype=dtype), directions.to(dtype), focal_length=FOCAL, alpha_threshold=1 / 255
    )
    expected, behind = reference(*(tensor.double().numpy() for tensor in scene), directions.numpy(), False, 0.0)
    assert np.abs(image.numpy() - expected).max() < tolerance * max(1, expected.max())
    assert np.abs(left.numpy() - behind).max() < tolerance


@pytest.mark.parametrize("threshold", [1e-7, 1 / 255, 0.5])
def test_float32_shows_what_float64_does_at_any_threshold(threshold):
    pictures = []
    for dtype in (torch.float32, torch.float64):
        scene, directions = gaussians(2000, dtype=dtype), latlong(90, dtype=dtype)
        place = torch.zeros(3, dtype=dtype)
        image, left = rasterize_directions(*scene, place, directions, focal_length=FOCAL, alpha_threshold=threshold)
        pictures.append(torch.cat([image, left[..., None]], dim=2).double())
    difference = (pictures[0] - pictures[1]).abs()
    # Where an alpha is at the threshold, rounding decides whether it counts.
    assert difference.median() < 1e-5 and (difference > 1e-3).float().mean() < 0.01


def test_opaque_gaussians_end_a_pixel_and_huge_ones_cover_all():
    means = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0], [0.0, 0.1, 4.0]])
    scales, turns = torch.full((3, 3), 3.0), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(3, 4)
    opacities, features = torch.tensor([0.99, 0.995, 1.0]), torch.eye(3)
    directions = latlong(64, dtype=torch.float32)
    image, left = rasterize_directions(
        means, scales, turns, opacities, features, torch.zeros(3), directions, focal_length=FOCAL
    )
    ahead = directions[..., 2] > 0.5
    assert torch.allclose(image[ahead][:, 0], torch.tensor(0.99), atol=0.02)
    assert (image[ahead][:, 2] < 1e-3).all() and (left[ahead] >= 1e-4).all()
    assert image[directions[..., 2] < 0].abs().max() == 0 and left[directions[..., 2] < 0].min() == 1


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradients_of_a_picture_are_the_sums_of_those_of_its_pixels(dtype):
    """Many Gaussians, some of them opaque: pixels end at different ones, and some alphas are at their limit."""
    scene, directions = gaussians(900, dtype=dtype, size=-1.0), scattered(18, 11).to(dtype)
    scene[3][::3] = 1.0

    def gradients(directions: torch.Tensor) -> list[torch.Tensor]:
        leaves = [tensor.clone().requires_grad_() for tensor in scene]
        image, left = rasterize_directions(*leaves, torch.zeros(3, dtype=dtype), directions, focal_length=FOCAL)
        return list(torch.autograd.grad(image.square().sum() + left.square().sum(), leaves))

    singles = [gradients(directions[row, column][None, None]) for row in range(18) for column in range(11)]
    for whole, parts in zip(gradients(directions), zip(*singles, strict=True), strict=True):
        assert float(whole.abs().max()) > 0
        assert relative_error(whole, sum(part.double() for part in parts)) < (1e-12 if dtype is torch.float64 else 1e-5)


@pytest.mark.parametrize("which", range(5))
def test_gradients_of_scattered_directions_match_finite_differences(which):
    tensors, directions = gaussians(9, size=-0.7), scattered(5, 13)
    tensors[3] = tensors[3] * 0.3

    def loss(*tensors):
        place = torch.tensor([0.1, -0.2, 0.15], dtype=torch.float64)
        image, left = rasterize_directions(*tensors, place, directions, focal_length=FOCAL, alpha_threshold=1e-7)
        return (image * random_like(image, 5)).sum() + left.square().sum()

    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    loss(*leaves).backward()
    assert relative_error(leaves[which].grad, finite_differences(loss, tensors, which)) < 1e-6
