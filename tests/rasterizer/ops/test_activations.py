"""Exposures of parameters and the penalty on opacities: kernels against torch in float64, and finite differences."""

import math

import pytest
import torch

from sehdr_warp.rasterizer.ops import activations
from sehdr_warp.rasterizer.ops.activations import bounded_exponential, opacity_penalty

from ..scenes import finite_differences, random_like, relative_error

BOUND = 2.5
EXPONENTIALS = [bounded_exponential, activations._BoundedExponential.apply]
PENALTIES = [opacity_penalty, activations._OpacityPenalty.apply]


@pytest.mark.parametrize("function", EXPONENTIALS)
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_exponentials_are_torchs(device, function, dtype, bound, count):
    truth = (
        2 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ).requires_grad_()
    values = truth.detach().to(device, dtype).requires_grad_()
    expected = truth.clamp(-BOUND, BOUND).exp()
    # As the blend gives them: columns of wider rows.
    weights = random_like(torch.empty(count, 8, dtype=torch.float64), 1)[:, 2:5]
    function(values, BOUND).backward(weights.to(device, dtype))
    expected.backward(weights)
    assert relative_error(function(values, BOUND), expected) <= bound
    assert relative_error(values.grad, truth.grad) <= bound


@pytest.mark.parametrize("function", EXPONENTIALS)
def test_the_gradient_of_exponentials_is_that_of_finite_differences(device, function):
    values = torch.tensor([[-4.0, -2.4, 0.0], [0.3, 2.4, 4.0]], dtype=torch.float64, device=device)
    weights = random_like(values, 1)
    numeric = finite_differences(lambda x: (function(x, BOUND) * weights).sum(), [values], 0)
    (function(values.requires_grad_(), BOUND) * weights).sum().backward()
    assert relative_error(values.grad, numeric) < 1e-9


@pytest.mark.parametrize("function", EXPONENTIALS)
def test_exponentials_at_and_beyond_the_bounds(device, function):
    values = torch.tensor([[-BOUND, BOUND, math.inf], [-math.inf, 0.0, math.nan]], device=device).requires_grad_()
    result = function(values, BOUND)
    result.sum().backward()
    ends = math.exp(-BOUND), math.exp(BOUND)
    expected = torch.tensor([[*ends, ends[1]], [ends[0], 1.0, math.nan]])
    torch.testing.assert_close(result.detach().cpu(), expected, equal_nan=True)
    assert values.grad[0].tolist() == [0, 0, 0] and values.grad[1, :2].tolist() == [0, 1]


def opacities_in_view(count, device, dtype=torch.float32):
    """Return opacities, extents of which about a third are 0, and second moments of which about a half are."""
    generator = torch.Generator().manual_seed(0)
    opacities, moments = torch.rand(2, count, generator=generator, dtype=torch.float64)
    extents = torch.rand(count, 2, generator=generator, dtype=torch.float64).sub(0.2).clamp_min(0)
    extents[extents.amin(1) == 0] = 0  # Culled Gaussians have neither.
    return [values.to(device, dtype) for values in (opacities, extents, moments.sub(0.5).clamp_min(0))]


@pytest.mark.parametrize("function", PENALTIES)
@pytest.mark.parametrize("count", [1, 7, 40_000])
@pytest.mark.parametrize("spare", [None, 0, 5])
@pytest.mark.parametrize("counted", ["all", "in view", "in view or moving"])
def test_the_penalty_is_the_sum_of_what_counts_over_the_number_of_gaussians(device, function, count, spare, counted):
    opacities, extents, moments = opacities_in_view(count, device)
    visible, moving = extents[:, 0] > 0, moments > 0
    counts = {"all": torch.ones_like(visible), "in view": visible, "in view or moving": visible | moving}[counted]
    expected, active_count = 1.5 * float((opacities.double() * counts).sum()) / count, None
    if spare is not None:
        opacities = torch.cat([opacities, opacities.new_zeros(spare)])
        extents = torch.cat([extents, extents.new_zeros(spare, 2)])
        moments = torch.cat([moments, moments.new_zeros(spare)])
        active_count = torch.tensor([count], dtype=torch.int32, device=device)
    arguments = None if counted == "all" else extents, moments if counted == "in view or moving" else None
    penalty = function(opacities.requires_grad_(), *arguments, 1.5, active_count)
    (3 * penalty).backward()
    assert penalty.item() == pytest.approx(expected, rel=1e-5, abs=1e-12)
    torch.testing.assert_close(opacities.grad[:count], (4.5 / count * counts).float())


@pytest.mark.parametrize("function", PENALTIES)
def test_the_gradient_of_the_penalty_is_that_of_finite_differences(device, function):
    opacities, extents, moments = opacities_in_view(11, device, torch.float64)
    numeric = finite_differences(lambda values: 2 * function(values, extents, moments, 0.7, None), [opacities], 0)
    (2 * function(opacities.requires_grad_(), extents, moments, 0.7, None)).backward()
    assert relative_error(opacities.grad, numeric) < 1e-9
