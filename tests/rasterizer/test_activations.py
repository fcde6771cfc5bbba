"""Exposures and opacities of parameters: the kernels against torch's own operations in float64, and finite
differences."""

import math

import pytest
import torch

from sehdr_warp.rasterizer import activations
from sehdr_warp.rasterizer.activations import bounded_exponential, opacities_with_penalty

from .scenes import finite_differences, random_like, relative_error

BOUND = 2.5
EXPONENTIALS = [bounded_exponential, activations._BoundedExponential.apply]
OPACITIES = [opacities_with_penalty, activations._Opacities.apply]


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


@pytest.mark.parametrize("function", OPACITIES)
@pytest.mark.parametrize("count", [1, 7, 40_000])
@pytest.mark.parametrize("spare", [None, 0, 5])
@pytest.mark.parametrize("which", [(1.0, 0.0), (0.0, 3.0), (1.0, 3.0)])
def test_opacities_their_mean_and_its_gradient_are_torchs_in_float64(device, count, function, spare, which):
    logits = (2 * torch.randn(count, generator=torch.Generator().manual_seed(0))).to(device)
    truth, live = logits.double().requires_grad_(), None
    if spare is not None:
        logits = torch.cat([logits, torch.full((spare,), -1e4, device=device)])
        live = torch.tensor([count], dtype=torch.int32, device=device)
    opacities, mean = function(logits.requires_grad_(), 1.5, live)
    true_opacities = torch.sigmoid(truth)
    true_mean = 1.5 * true_opacities.mean()
    weights = random_like(opacities, 1)
    # What nobody asks for has no gradient at all.
    of = [w * x for w, x in zip(which, ((opacities * weights).sum(), mean), strict=True) if w]
    true_of = [w * x for w, x in zip(which, ((true_opacities * weights[:count]).sum(), true_mean), strict=True) if w]
    sum(of).backward()
    sum(true_of).backward()
    assert mean.item() == pytest.approx(true_mean.item(), rel=1e-6)
    assert relative_error(opacities[:count], true_opacities) < 1e-6 and not opacities[count:].any()
    assert relative_error(logits.grad[:count], truth.grad) < 1e-5
    assert not logits.grad[count:].any()


@pytest.mark.parametrize("function", OPACITIES)
def test_the_gradient_of_opacities_is_that_of_finite_differences(device, function):
    logits = torch.linspace(-4, 4, 11, dtype=torch.float64, device=device)
    weights = random_like(logits, 1)

    def loss(values):
        opacities, mean = function(values, 0.7, None)
        return (opacities * weights).sum() + 2 * mean

    numeric = finite_differences(loss, [logits], 0)
    loss(logits.requires_grad_()).backward()
    assert relative_error(logits.grad, numeric) < 1e-9
