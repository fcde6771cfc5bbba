"""The SSIM kernels against a float64 convolution."""

from importlib import import_module

import pytest
import torch
import torch.nn.functional as F
import warp as wp

from sehdr_warp.rasterizer.losses import patches
from sehdr_warp.rasterizer.losses.ssim import image_distance, ssim, ssim_map

SHAPES = [(32, 48, 3), (37, 29, 3), (5, 4, 3), (1, 1, 1), (1, 40, 2), (40, 1, 3), (11, 11, 1), (16, 9, 27), (3, 2, 9)]


def conv_ssim(a, b):
    """The usual quotient by 2D convolutions, [H, W, C] -> [H, W, C]."""
    axis = torch.arange(11, dtype=a.dtype, device=a.device) - 5
    g = torch.exp(-(axis**2) / (2 * 1.5**2))
    g = g / g.sum()
    channels = a.shape[2]
    kernel = torch.outer(g, g).expand(channels, 1, 11, 11).contiguous()
    x, y = a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None]

    def blur(image):
        return F.conv2d(image, kernel, padding=5, groups=channels)

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    result = ((2 * mx * my + c1) * (2 * vxy + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return result[0].permute(1, 2, 0)


def images(shape, device="cpu", dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(shape, generator=generator, dtype=torch.float64)
    b = (a + 0.3 * torch.randn(shape, generator=generator, dtype=torch.float64)).clamp(0, 1)
    return a.to(device, dtype), b.to(device, dtype)


def relative_error(value, truth):
    return float((value.double() - truth).norm() / truth.norm())


@pytest.fixture(params=["runs", "single", "patches"])
def kernels(request, monkeypatch, device):
    """All kernels on the CPU: runs of 16, those of narrow images, and those of a GPU, emulated."""
    module = import_module("sehdr_warp.rasterizer.losses.ssim")
    if request.param == "single":
        monkeypatch.setattr(module, "CPU_LANES", 1)
    elif request.param == "patches" and device == "cpu":
        monkeypatch.setattr(patches, "in_patches", lambda device: True)
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    elif device != "cpu" and request.param != "patches":
        pytest.skip("kernels of the CPU")


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_values_and_gradients_equal_the_convolution(shape, dtype, tolerance, device, kernels):
    a, b = images(shape, device)
    a.requires_grad_(), b.requires_grad_()
    expected_map = conv_ssim(a, b)
    expected = torch.autograd.grad(expected_map.mean(), (a, b))
    x, y = a.detach().to(dtype).requires_grad_(), b.detach().to(dtype).requires_grad_()
    value = ssim(x, y)
    value.backward()
    assert value.dtype == dtype and value.shape == ()
    assert abs(value.item() - expected_map.mean().item()) < tolerance
    assert (ssim_map(x, y).double() - expected_map).abs().max() < 20 * tolerance
    assert relative_error(x.grad, expected[0]) < 10 * tolerance
    assert relative_error(y.grad, expected[1]) < 10 * tolerance


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_the_distance_is_the_weighted_sum(shape, dtype, tolerance, device, kernels):
    a, b = images(shape, device)
    a.view(-1)[1::5] = b.view(-1)[1::5]  # where they are equal, |a - b| pulls neither way
    a.requires_grad_()
    expected = 0.7 * (a - b).abs().mean() + 0.3 * (1 - conv_ssim(a, b).mean())
    expected.backward()
    x, y = a.detach().to(dtype).requires_grad_(), b.to(dtype)
    value = image_distance(x, y, 0.7, 0.3)
    (2 * value).backward()
    assert value.dtype == dtype and value.shape == ()
    assert abs(value.item() - expected.item()) < tolerance
    # Of equal numbers float32 makes equal numbers: the sides are those of float64.
    assert relative_error(x.grad / 2, a.grad) < 10 * tolerance


def test_map_gradient_takes_a_weight_per_pixel(device):
    a, b = images((17, 12, 3), device)
    weights = torch.linspace(-1, 2, a.numel(), dtype=a.dtype, device=device).reshape(a.shape)
    a.requires_grad_()
    (expected,) = torch.autograd.grad((conv_ssim(a, b) * weights).sum(), a)
    (gradient,) = torch.autograd.grad((ssim_map(a, b) * weights).sum(), a)
    assert relative_error(gradient, expected) < 1e-11


@pytest.mark.parametrize("level", [0.0, 1e-30, 0.5, 1.0, 100.0, 1e4, 1e15])
def test_constant_images(level, device):
    a = torch.full((20, 30, 3), level, device=device, requires_grad=True)
    same = ssim(a, a.detach().clone())
    same.backward()
    assert same.item() == pytest.approx(1.0, abs=1e-6)
    assert torch.isfinite(a.grad).all() and a.grad.abs().max() < 1e-6
    other = torch.full((20, 30, 3), level + 0.25, device=device)
    expected = conv_ssim(other.double(), a.detach().double()).mean().item()
    assert ssim(other, a.detach()).item() == pytest.approx(expected, abs=1e-4)


def test_bright_images_keep_their_digits(device):
    """At 1e4 the moments are of order 1e8; the gradient in float32 must still match float64."""
    a, b = (image * 1e4 for image in images((40, 50, 3), device))
    a.requires_grad_()
    (expected,) = torch.autograd.grad(conv_ssim(a, b).mean(), a)
    x = a.detach().float().requires_grad_()
    value = ssim(x, b.float())
    value.backward()
    assert value.item() == pytest.approx(conv_ssim(a, b).mean().item(), abs=1e-5)
    assert relative_error(x.grad, expected) < 1e-4


def test_nearly_equal_bright_images_are_nearly_one(device):
    """The usual quotient in float32 returns noise here, since its variances cancel."""
    a = torch.full((32, 32, 3), 5000.0, device=device)
    b = a + 1e-2 * torch.rand(a.shape, generator=torch.Generator().manual_seed(1)).to(device)
    expected = conv_ssim(a.double(), b.double()).mean().item()
    assert ssim(a, b).item() == pytest.approx(expected, abs=0.02)
    assert ssim(a, b).item() <= 1.0


def test_the_number_of_threads_changes_nothing(monkeypatch):
    a, b = images((300, 310, 3), dtype=torch.float32)
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("SEHDR_THREADS", threads)
        x = a.clone().requires_grad_()
        value = ssim(x, b)
        value.backward()
        results.append((value.item(), x.grad))
    assert results[0][0] == results[1][0]
    assert torch.equal(results[0][1], results[1][1])


def test_views_and_slices_are_read_right(device):
    a, b = images((20, 24, 3), device)
    whole = torch.zeros(40, 48, 3, dtype=a.dtype, device=device)
    whole[5:25, 7:31] = a
    planes = b.permute(2, 0, 1).contiguous()
    assert ssim(whole[5:25, 7:31], planes.permute(1, 2, 0)).item() == pytest.approx(ssim(a, b).item(), abs=1e-14)
