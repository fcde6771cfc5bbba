"""Culled means gone: what is not finite or out of range shows nothing and leaves every gradient as it is without it."""

import math

import pytest
import torch

from sehdr_warp.rasterizer import rasterize, rasterize_directions, spherical_harmonics

from .scenes import random_like

NAN, INF = math.nan, math.inf
WIDTH, HEIGHT = 40, 30
BAD = [(place, value) for place in range(5) for value in (NAN, INF, -INF)] + [(0, 1e30), (0, -1e30), (1, 1e30)]


def scene(device, dtype, count=12):
    generator = torch.Generator().manual_seed(7)
    means = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    means[:, 2] += 3.0
    tensors = (
        means,
        torch.full((count, 3), -1.8, dtype=torch.float64),
        torch.randn(count, 4, generator=generator, dtype=torch.float64),
        torch.full((count,), 0.6, dtype=torch.float64),
        torch.rand(count, 3, generator=generator, dtype=torch.float64),
    )
    return [tensor.to(device, dtype) for tensor in tensors]


def cameras(device, dtype):
    pose, lens = torch.eye(4, dtype=dtype, device=device), torch.tensor([40.0, 41, 20, 15], dtype=dtype, device=device)
    return pose, lens


def gradients(function, tensors):
    leaves = [tensor.detach().clone().requires_grad_() for tensor in tensors]
    image = function(*leaves)
    (image * random_like(image, 3)).sum().backward()
    return image.detach(), [leaf.grad for leaf in leaves]


def assert_gone(function, gaussians, shared, place, value):
    bad, part = [tensor.clone() for tensor in gaussians], slice(3, 5)
    bad[place][part] = value
    others = torch.ones(len(bad[0]), dtype=torch.bool, device=bad[0].device)
    others[part] = False
    image, grads = gradients(function, [*bad, *shared])
    truth, expected = gradients(function, [*(tensor[others] for tensor in gaussians), *shared])
    torch.testing.assert_close(image, truth, rtol=1e-6, atol=1e-7)
    # A GPU sums in any order.
    rounding = 1e-4 if image.is_cuda and image.dtype == torch.float32 else 1e-7
    for gradient, true in zip(grads[: len(bad)], expected, strict=False):
        assert bool((gradient[part] == 0).all())
        torch.testing.assert_close(gradient[others], true, rtol=1e-5, atol=rounding)
    for gradient, true in zip(grads[len(bad) :], expected[len(bad) :], strict=True):
        torch.testing.assert_close(gradient, true, rtol=1e-5, atol=max(100 * rounding, 1e-5))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("place, value", BAD)
def test_a_gaussian_that_is_not_finite_is_gone(place, value, dtype, device):
    if place == 1 and value == 1e30:
        pytest.skip("a size has a largest value")

    def draw(*tensors):
        return rasterize(*tensors, WIDTH, HEIGHT, antialiased=place % 2 == 0).image

    assert_gone(draw, scene(device, dtype), cameras(device, dtype), place, value)


def test_a_quaternion_of_zeros_turns_nothing_and_has_no_gradient(device):
    gaussians, shared = scene(device, torch.float32), cameras(device, torch.float32)
    gaussians[2][3] = 0.0
    arguments = [*gaussians, *shared]
    image, grads = gradients(lambda *tensors: rasterize(*tensors, WIDTH, HEIGHT).image, arguments)
    assert not grads[2][3].any() and grads[2].any()
    gaussians[2][3] = torch.tensor([1.0, 0, 0, 0])
    assert torch.equal(rasterize(*arguments, WIDTH, HEIGHT).image, image)


@pytest.mark.parametrize("place, value", BAD[:-1])
def test_nor_is_it_seen_in_a_panorama(place, value, device):
    grid = torch.meshgrid(torch.linspace(-0.5, 0.5, 24), torch.linspace(-0.4, 0.4, 20), indexing="xy")
    rays = torch.nn.functional.normalize(torch.stack([*grid, torch.ones_like(grid[0])], -1).double(), dim=-1).to(device)

    def draw(*tensors):
        return rasterize_directions(*tensors, rays, focal_length=40.0)[0]

    position = torch.zeros(3, dtype=torch.float64, device=device)
    assert_gone(draw, scene(device, torch.float64), [position], place, value)


@pytest.mark.parametrize("bad", ["mean", "coefficient"])
def test_harmonics_of_a_gaussian_that_is_gone_leave_the_position_its_gradient(bad, device):
    gaussians = scene(device, torch.float64)
    coefficients = torch.randn(12, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(device)
    position = torch.zeros(3, dtype=torch.float64, device=device)

    def draw(means, log_scales, quaternions, opacities, coefficients, position):
        colors = spherical_harmonics(3, coefficients, means, position)
        return rasterize(
            means, log_scales, quaternions, opacities, colors, *cameras(device, torch.float64), WIDTH, HEIGHT
        ).image

    place = 0 if bad == "mean" else 4
    assert_gone(draw, [*gaussians[:4], coefficients], [position], place, NAN)


def test_a_camera_that_is_not_finite_shows_nothing_on_a_gpu_and_is_refused_on_the_cpu(device):
    gaussians, (pose, lens) = scene(device, torch.float32), cameras(device, torch.float32)
    for bad in ([pose * NAN, lens], [pose, lens * NAN], [pose * INF, lens]):
        arguments = [*gaussians, *bad]
        if device == "cpu":
            with pytest.raises(ValueError, match="finite"):
                rasterize(*arguments, WIDTH, HEIGHT)
            continue
        image, grads = gradients(lambda *t: rasterize(*t, WIDTH, HEIGHT).image, arguments)
        assert bool((image == 0).all()) and all(bool((gradient == 0).all()) for gradient in grads)


def test_sizes_of_nearly_nothing_are_drawn_with_finite_gradients(device):
    gaussians = scene(device, torch.float32)
    gaussians[1][:] = -80.0
    image, grads = gradients(
        lambda *t: rasterize(*t, WIDTH, HEIGHT).image, [*gaussians, *cameras(device, torch.float32)]
    )
    assert bool((image > 0).any()) and all(bool(gradient.isfinite().all()) for gradient in grads)
