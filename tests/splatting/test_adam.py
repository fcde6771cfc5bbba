"""Our step of Adam against torch's."""

import pytest
import torch

from sehdr_warp.splatting.adam import adam_step

OPTIONS = {"betas": (0.9, 0.999), "epsilon": 1e-15}


def run_ours(parameter, gradients, rate, skip=()):
    one = torch.ones((), device=parameter.device)
    first, second, step = torch.zeros_like(parameter), torch.zeros_like(parameter), 0 * one
    for number, gradient in enumerate(gradients):
        skipped = one * (number in skip)
        step += 1 - skipped
        adam_step(parameter, gradient, first, second, step, skipped, rate=one * rate, rate_factor=0.5, **OPTIONS)
    return first, second, step


@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e12])
def test_many_steps_are_torchs_in_float64(device, scale):
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(37, 3, generator=generator)
    gradients = [scale * torch.randn(37, 3, generator=generator) for _ in range(40)]
    truth = torch.nn.Parameter(start.double())
    optimizer = torch.optim.Adam([truth], lr=0.01, eps=1e-15)
    for gradient in gradients:
        truth.grad = gradient.double()
        optimizer.step()
    ours = start.to(device, copy=True)
    first, second, _ = run_ours(ours, [gradient.to(device) for gradient in gradients], 0.02)
    assert (ours.cpu() - truth).abs().max() < 1e-5 * 0.4
    state = optimizer.state[truth]
    for moment, true_moment in ((first, state["exp_avg"]), (second, state["exp_avg_sq"])):
        assert ((moment.cpu() - true_moment).norm() / true_moment.norm()) < 1e-6


def test_a_skipped_step_changes_nothing(device):
    gradients = [torch.full((5,), value, device=device) for value in (1.0, float("nan"), -0.5)]
    with_skip, without = torch.zeros(5, device=device), torch.zeros(5, device=device)
    *moments, step = run_ours(with_skip, gradients, 0.1, skip={1})
    run_ours(without, [gradients[0], gradients[2]], 0.1)
    assert step == 2
    assert torch.equal(with_skip, without)
    assert all(moment.isfinite().all() for moment in moments)


def test_no_numbers_are_no_work_and_another_layout_is_refused(device):
    empty, one = torch.zeros(0, 3, device=device), torch.ones((), device=device)
    adam_step(empty, empty, empty, empty, one, one, rate=one, rate_factor=1.0, **OPTIONS)
    square = torch.zeros(4, 4, device=device)
    with pytest.raises(ValueError, match="gradient is torch.float32"):
        adam_step(square, torch.zeros(3, device=device), square, square, one, one, rate=one, rate_factor=1.0, **OPTIONS)
    with pytest.raises(ValueError, match="second moment is torch.float64"):
        adam_step(square, square, square, square.double(), one, one, rate=one, rate_factor=1.0, **OPTIONS)
