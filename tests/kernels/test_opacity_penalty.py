"""The penalty on opacities: its kernels against torch, and finite differences."""

import math

import pytest
import torch

from sehdr_warp.rasterizer.losses.opacity_penalty import opacity_penalty, penalty_by_kernels

from ..rasterizer.scenes import finite_differences, relative_error

PENALTIES = [opacity_penalty, penalty_by_kernels]


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


@pytest.mark.parametrize("function", PENALTIES)
def test_gaussians_that_do_not_count_may_have_any_opacity_and_none_are_no_penalty(device, function):
    opacities = torch.tensor([0.5, math.nan, math.inf], device=device, requires_grad=True)
    extents = torch.tensor([[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]], device=device)
    penalty = function(opacities, extents, None, 1.5, None)
    penalty.backward()
    assert penalty.item() == 0.25 and opacities.grad.tolist() == [0.5, 0.0, 0.0]
    assert function(opacities[:0], extents[:0], None, 1.5, None).item() == 0.0
