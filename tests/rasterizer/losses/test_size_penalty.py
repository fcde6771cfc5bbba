"""The penalty on angular sizes: its kernels against torch in float64, finite differences and extreme sizes."""

import math

import pytest
import torch

from sehdr_warp.kernels.constants import LOG_SCALE_MAX
from sehdr_warp.rasterizer.losses.size_penalty import LEAST_DISTANCE, size_penalty

from ..scenes import finite_differences, relative_error


def gaussians_around(count, device, dtype=torch.float32):
    """Return log scales [N, 3] and means [N, 3], and the position [3] of a camera; the first mean is at the camera."""
    generator = torch.Generator().manual_seed(count)
    log_scales = torch.randn(count, 3, generator=generator, dtype=torch.float64) - 3
    means = 2 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    position = torch.tensor([0.3, -0.2, 1.1], dtype=torch.float64)
    means[0] = position
    return [values.to(device, dtype) for values in (log_scales, means, position)]


def reference(log_scales, means, position, weight):
    distances = (means - position).norm(dim=1, keepdim=True).clamp_min(LEAST_DISTANCE)
    return weight * (log_scales.exp() / distances).mean()


@pytest.mark.parametrize("count", [1, 7, 40_000])
@pytest.mark.parametrize("spare", [None, 0, 5])
def test_the_penalty_is_the_mean_of_sizes_over_distances(device, count, spare):
    log_scales, means, position = gaussians_around(count, device)
    exact = log_scales.detach().double().requires_grad_()
    expected = reference(exact, means.double(), position.double(), 1.5)
    (3 * expected).backward()
    active_count = None
    if spare is not None:
        log_scales, means = (torch.cat([values, values.new_full((spare, 3), 5.0)]) for values in (log_scales, means))
        active_count = torch.tensor([count], dtype=torch.int32, device=device)
    penalty = size_penalty(log_scales.requires_grad_(), means, position, 1.5, active_count)
    (3 * penalty).backward()
    assert penalty.item() == pytest.approx(expected.item(), rel=1e-5)
    torch.testing.assert_close(log_scales.grad[:count], exact.grad.float(), rtol=1e-4, atol=0)
    assert not log_scales.grad[count:].any()


def test_the_gradient_of_the_penalty_is_that_of_finite_differences(device):
    log_scales, means, position = gaussians_around(11, device, torch.float64)
    numeric = finite_differences(lambda values: 2 * size_penalty(values, means, position, 0.7), [log_scales], 0)
    (2 * size_penalty(log_scales.requires_grad_(), means, position, 0.7)).backward()
    assert relative_error(log_scales.grad, numeric) < 1e-8


def test_sizes_of_0_and_without_bound_leave_the_penalty_finite(device):
    log_scales, means, position = gaussians_around(3, device)
    log_scales[1], log_scales[2] = -math.inf, math.inf
    penalty = size_penalty(log_scales.requires_grad_(), means, position, 0.01)
    penalty.backward()
    assert penalty.isfinite() and log_scales.grad.isfinite().all()
    assert not log_scales.grad[1].any()
    largest = 0.01 / 9 * math.exp(LOG_SCALE_MAX) / (means[2] - position).norm().item()
    assert log_scales.grad[2].amax().item() == pytest.approx(largest, rel=1e-4)
