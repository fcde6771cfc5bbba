"""Adaptive density control: who grows, who goes, and what stays the same."""

import math
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.model.gaussians import PARAMETER_NAMES, Gaussians, rotate
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.strategies import make_strategy
from sehdr_warp.training.strategies.adc import split


def cloud(count=6):
    generator = torch.Generator().manual_seed(5)
    return Gaussians.from_points(
        torch.rand(count, 3, generator=generator), torch.rand(count, 3, generator=generator), 1
    )


def adam(gaussians):
    parameters = [getattr(gaussians, name) for name in PARAMETER_NAMES]
    groups = [{"name": n, "params": [p], "lr": 0.01} for n, p in zip(PARAMETER_NAMES, parameters, strict=True)]
    optimizer = torch.optim.Adam(groups)
    for parameter in parameters:
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    return optimizer


def rendering_with(gradient, visible):
    means2d = torch.zeros_like(gradient)
    means2d.grad = gradient
    return SimpleNamespace(means2d=means2d, radii=visible.float())


def adc_strategy(**options):
    values = {"densification.strategy": "adc"}
    values |= {f"densification.{name}": value for name, value in options.items()}
    return make_strategy(load_config("default", values), 10**6)


def observe(strategy, gradients):
    """Screen gradients along x, in normalised units for an image 200 wide."""
    gradient = torch.tensor(gradients)[:, None] * torch.tensor([[1 / 100.0, 0.0]])
    strategy.allocate(len(gradients), "cpu")
    strategy.accumulate(rendering_with(gradient, torch.ones(len(gradients), dtype=bool)), 200, 100, torch.tensor(1.0))


def test_statistics_are_means_over_the_photos_that_show_it():
    strategy = adc_strategy()
    gradient = torch.tensor([[3.0, 0.0], [0.0, 4.0]])
    strategy.allocate(2, "cpu")
    strategy.accumulate(rendering_with(gradient, torch.tensor([True, True])), 200, 100, torch.tensor(1.0))
    strategy.accumulate(
        rendering_with(gradient * float("nan"), torch.tensor([True, True])), 200, 100, torch.tensor(0.0)
    )
    strategy.accumulate(rendering_with(gradient, torch.tensor([True, False])), 200, 100, torch.tensor(1.0))
    assert strategy.gradient_sum.tolist() == [600.0, 200.0] and strategy.photo_count.tolist() == [2.0, 1.0]


def test_small_are_cloned_and_large_are_split():
    gaussians = cloud(3)
    small, large = 0.001, 0.5
    gaussians.overwrite({"log_scales": torch.tensor([small, large, small]).log()[:, None].expand(3, 3)})
    optimizer = adam(gaussians)
    before = gaussians.rows(torch.arange(3))
    strategy = adc_strategy()
    observe(strategy, [1.0, 1.0, 0.0])
    assert strategy.refine(600, gaussians, optimizer, torch.Generator().manual_seed(0))
    # Kept: 0 and 2; added: a clone of 0, and two halves of 1.
    assert gaussians.count == 5
    torch.testing.assert_close(gaussians.means[:3].detach(), before["means"][[0, 2, 0]])
    halves = gaussians.log_scales[3:].detach()
    torch.testing.assert_close(halves, (before["log_scales"][1] - math.log(1.6)).expand(2, 3))
    assert not torch.equal(gaussians.means[3], gaussians.means[4])
    for name in PARAMETER_NAMES:
        parameter = getattr(gaussians, name)
        moments = optimizer.state[parameter]["exp_avg"]
        assert moments.shape == parameter.shape and (moments[:2] != 0).all() and (moments[2:] == 0).all()
        assert any(parameter is p for group in optimizer.param_groups for p in group["params"])


def test_split_points_are_drawn_from_the_parent():
    gaussians = cloud(20_000)
    scales = torch.tensor([0.5, 0.01, 0.2])
    quaternion = torch.tensor([0.3, -0.5, 0.7, 0.2])
    gaussians.overwrite({"log_scales": scales.log().expand(20_000, 3), "quaternions": quaternion.expand(20_000, 4)})
    half, other = split(gaussians, torch.ones(20_000, dtype=torch.bool), torch.Generator().manual_seed(1))
    assert not torch.equal(half["means"], other["means"])
    offsets = half["means"] - gaussians.means.detach()
    rotation = rotate(quaternion.expand(3, 4), torch.eye(3)).T
    expected = rotation @ torch.diag(scales**2) @ rotation.T
    torch.testing.assert_close(torch.cov(offsets.T), expected, atol=0.01, rtol=0.05)


def test_statistics_stay_where_recorded_steps_add_to_them():
    strategy, gaussians = adc_strategy(), cloud(4)
    observe(strategy, [1e-6] * 4)
    held = strategy.gradient_sum, strategy.photo_count
    for iteration in (600, 14_900):  # The last change too: steps after it still add.
        strategy.refine(iteration, gaussians, adam(gaussians), torch.Generator().manual_seed(0))
        strategy.allocate(4, "cpu")
        assert strategy.gradient_sum is held[0] and strategy.photo_count is held[1] and not torch.cat(held).any()
    strategy.allocate(6, "cpu")
    assert strategy.photo_count.shape == (6,) and strategy.state_dict(5)["seen"].shape == (5,)


def test_the_budget_goes_to_the_largest_gradients():
    gaussians = cloud(6)
    optimizer = adam(gaussians)
    # Neither faint nor huge, so that nothing is pruned.
    gaussians.overwrite({"log_scales": torch.full((6, 3), math.log(0.001)), "opacity_logits": torch.zeros(6)})
    strategy = adc_strategy(cap_max=8)
    observe(strategy, [0.1, 0.6, 0.2, 0.5, 0.3, 0.4])
    strategy.refine(600, gaussians, optimizer, torch.Generator())
    assert gaussians.count == 8
    torch.testing.assert_close(gaussians.means[6:].detach(), gaussians.means[[1, 3]].detach())


def test_faint_and_oversized_are_pruned():
    gaussians = cloud(5)
    optimizer = adam(gaussians)
    logits = torch.logit(torch.tensor([0.5, 0.004, 0.5, 0.5, 0.5]))
    scales = torch.tensor([0.01, 0.01, 0.3, 0.01, 0.01]).log()[:, None].expand(5, 3)
    gaussians.overwrite({"opacity_logits": logits, "log_scales": scales})
    strategy = adc_strategy()
    observe(strategy, [0.0] * 5)
    strategy.refine(2900, gaussians, optimizer, torch.Generator())
    assert gaussians.count == 4, "only the faint one before the first reset"
    observe(strategy, [0.0] * 4)
    strategy.refine(3100, gaussians, optimizer, torch.Generator())
    assert gaussians.count == 3, "0.3 is more than a tenth of the cameras' radius"


def test_opacity_reset():
    gaussians = cloud(3)
    optimizer = adam(gaussians)
    gaussians.overwrite({"opacity_logits": torch.logit(torch.tensor([0.9, 0.5, 0.006]))})
    strategy = adc_strategy()
    strategy.refine(3000, gaussians, optimizer, torch.Generator())
    torch.testing.assert_close(gaussians.opacities().detach(), torch.tensor([0.01, 0.01, 0.006]))
    assert (optimizer.state[gaussians.opacity_logits]["exp_avg"] == 0).all()
    assert (optimizer.state[gaussians.means]["exp_avg"] != 0).all()


@pytest.mark.parametrize("iteration", [500, 550, 15_100])
def test_nothing_changes_outside_the_schedule(iteration):
    gaussians, strategy = cloud(4), adc_strategy()
    observe(strategy, [1.0] * 4)
    assert not strategy.refine(iteration, gaussians, None, torch.Generator()) and gaussians.count == 4
