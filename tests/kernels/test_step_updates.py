"""Kernels of a training step beside rendering: Adam, decision on a step, gradient statistics, position noise."""

import math
from itertools import product

import pytest
import torch

from sehdr_warp.rasterizer import HarmonicsGradients, spherical_harmonics
from sehdr_warp.rasterizer.losses.ssim import image_distance
from sehdr_warp.rasterizer.ops.step_updates import (
    AdamStep,
    adam_steps,
    add_gradient_statistics,
    add_position_noise,
    decide_step,
    differentiate,
    finiteness_of,
    harmonics_adam_step,
    nonfinite_by_kernel,
    steps_by_kernel,
)

from .test_harmonics import inputs as harmonics_of

OPTIONS = {"betas": (0.9, 0.999), "epsilon": 1e-15}
COUNT, STRENGTH = 200_000, 0.5


def run_adam(step_function, parameter, gradients, rate, skip=()):
    one = torch.ones((), device=parameter.device)
    first, second, step = torch.zeros_like(parameter), torch.zeros_like(parameter), 0 * one
    for number, gradient in enumerate(gradients):
        skipped = one * (number in skip)
        step += 1 - skipped
        step_function([AdamStep(parameter, gradient, first, second, step, one * rate)], skipped, **OPTIONS)
    return first, second, step


@pytest.mark.parametrize("function", [adam_steps, steps_by_kernel])
@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e12])
def test_many_steps_are_torchs_in_float64(device, scale, function):
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(37, 3, generator=generator)
    gradients = [scale * torch.randn(37, 3, generator=generator) for _ in range(40)]
    truth = torch.nn.Parameter(start.double())
    optimizer = torch.optim.Adam([truth], lr=0.01, eps=1e-15)
    for gradient in gradients:
        truth.grad = gradient.double()
        optimizer.step()
    ours = start.to(device, copy=True)
    first, second, _ = run_adam(function, ours, [gradient.to(device) for gradient in gradients], 0.01)
    assert (ours.cpu() - truth).abs().max() < 1e-5 * 0.4
    state = optimizer.state[truth]
    for moment, true_moment in ((first, state["exp_avg"]), (second, state["exp_avg_sq"])):
        assert ((moment.cpu() - true_moment).norm() / true_moment.norm()) < 1e-6


@pytest.mark.parametrize("function", [adam_steps, steps_by_kernel])
def test_a_skipped_step_changes_nothing(device, function):
    gradients = [torch.full((5,), value, device=device) for value in (1.0, float("nan"), -0.5)]
    with_skip, without = torch.zeros(5, device=device), torch.zeros(5, device=device)
    *moments, step = run_adam(function, with_skip, gradients, 0.1, skip={1})
    run_adam(function, without, [gradients[0], gradients[2]], 0.1)
    assert step == 2
    assert torch.equal(with_skip, without)
    assert all(moment.isfinite().all() for moment in moments)


@pytest.mark.parametrize("function", [adam_steps, steps_by_kernel])
def test_many_parameters_step_as_each_by_itself(device, function):
    generator = torch.Generator().manual_seed(2)
    one = torch.ones((), device=device)
    cases = [
        [
            AdamStep(*(t.to(device, copy=True) for t in tensors), one, 0.01 * size)
            for size, tensors in ((n, torch.rand(4, n, 2, generator=generator)) for n in (5, 70, 1, 33, 12, 4))
        ]
        for generator in (generator, torch.Generator().manual_seed(2))
    ]
    function(cases[0], 0 * one, **OPTIONS)
    for step in cases[1]:
        function([step], 0 * one, **OPTIONS)
    for together, alone in zip(*cases, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(together[:4], alone[:4], strict=True))


@pytest.mark.parametrize("function", [finiteness_of, nonfinite_by_kernel])
@pytest.mark.parametrize("value", [math.inf, math.nan, 1e20])  # The square of the last is infinite.
@pytest.mark.parametrize("place", [None, 0, 9])
def test_one_number_that_is_not_finite_shows_in_the_result(device, place, value, function):
    gradients = [torch.ones(7 * k + 1, 3, device=device) for k in range(10)]
    if place is not None:
        gradients[place][-1, 2] = value
    assert bool(function(gradients).isfinite().all()) == (place is None)


def test_a_loss_is_differentiated_as_torch_does(device):
    values = torch.linspace(0, 1, 60, device=device).view(5, 4, 3).requires_grad_()
    other = torch.rand(5, 4, 3, generator=torch.Generator().manual_seed(0)).to(device)

    def loss():
        return image_distance(values, other, 0.8, 0.2) + values.square().sum()

    differentiate(loss())
    ours, values.grad = values.grad, None
    loss().backward()
    torch.testing.assert_close(ours, values.grad)


def test_rows_that_do_not_count_are_left_alone(device):
    values, other, one = torch.zeros(6, 4, device=device), torch.zeros(50, device=device), torch.ones((), device=device)
    steps = [
        AdamStep(tensor, torch.ones_like(tensor), torch.zeros_like(tensor), torch.zeros_like(tensor), one, one, width)
        for tensor, width in ((values, 4), (other, 0))
    ]
    active_count = torch.tensor([5], dtype=torch.int32, device=device)
    steps_by_kernel(steps, 0 * one, *OPTIONS.values(), active_count)
    assert (values[:5] == values[0, 0]).all() and values[0, 0] < 0 and not values[5].any() and other.all()
    moments = (torch.zeros(6, 15, 3, device=device) for _ in range(3))
    ones = torch.ones(6, 3, device=device)
    factors = HarmonicsGradients(ones[None], 0 * ones[:1], ones, 3)
    parameter, *state = moments
    harmonics_adam_step(parameter, 1, factors, *state, one, 0 * one, rate=0.1, **OPTIONS, active_count=active_count)
    assert parameter[:5, 1].all() and not parameter[5].any() and not state[0][5].any()


def test_no_numbers_are_no_work(device):
    empty, one = torch.zeros(0, 3, device=device), torch.ones((), device=device)
    parameter, moments = torch.ones(2, 3, device=device), torch.zeros(2, 2, 3, device=device)
    gradient = torch.ones_like(parameter)
    steps = [AdamStep(empty, empty, empty, empty, one, 0.1), AdamStep(parameter, gradient, *moments, one, 0.1)]
    adam_steps(steps, 0 * one, **OPTIONS)
    torch.testing.assert_close(parameter, torch.full_like(parameter, 0.9))


def test_a_step_is_skipped_where_something_is_not_finite_or_incomplete(device):
    for loss, norm, incomplete in product(
        [0.0, 3.0, math.inf, math.nan], [0.0, math.inf, math.nan], (None, False, True)
    ):
        overflow = None if incomplete is None else torch.tensor(incomplete, device=device)
        inputs = torch.tensor([1.0, norm, 2.0], device=device)
        nonfinite = not (math.isfinite(loss) and math.isfinite(norm))
        skipped = nonfinite or bool(incomplete)
        tally, pairs = (torch.tensor(values, device=device) for values in ([4, 7, 2], 9))
        for counted in (None, pairs):
            flags = decide_step(torch.tensor(loss, device=device), inputs, overflow, tally, counted)
            assert [float(value) for value in flags] == [skipped, not skipped]
        assert tally.tolist() == [4 + 2 * nonfinite, 9, 2 + bool(incomplete)]


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_factors_of_two_views_are_multiplied_out_as_torchs_adam_steps_in_float64(device, degree):
    coefficients, means, camera = harmonics_of()
    positions, upstream = torch.stack([camera, -camera]), torch.linspace(-1, 1, 120, dtype=torch.float64).view(2, 20, 3)
    truth = torch.nn.Parameter(coefficients)
    optimizer = torch.optim.Adam([truth], lr=0.01, eps=1e-15)
    gradients = HarmonicsGradients(*(t.float().to(device) for t in (upstream, positions, means)), degree)
    parts = [(0, coefficients[:, :1]), (1, coefficients[:, 1:])]
    states = [
        (k, part.float().to(device).contiguous(), *torch.zeros(2, *part.shape, device=device)) for k, part in parts
    ]
    one = torch.ones((), device=device)
    for number in (1, 2, 3):
        optimizer.zero_grad()
        for position, by_value in zip(positions, upstream, strict=True):
            (spherical_harmonics(degree, truth, means, position) * by_value).sum().backward()
        optimizer.step()
        for start, parameter, *moments in states:
            harmonics_adam_step(parameter, start, gradients, *moments, number * one, 0 * one, rate=0.01, **OPTIONS)
            before = parameter.clone()
            harmonics_adam_step(parameter, start, gradients, *moments, number * one, one, rate=0.01, **OPTIONS)
            assert torch.equal(parameter, before)
    expected = truth, *(optimizer.state[truth][name] for name in ("exp_avg", "exp_avg_sq"))
    for mine, true in zip(zip(*(state[1:] for state in states), strict=True), expected, strict=True):
        torch.testing.assert_close(torch.cat(mine, 1).cpu().double(), true.detach(), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("count", [60, 100])
def test_parts_of_the_coefficients_step_in_turn(device, count):
    generator = torch.Generator().manual_seed(1)
    start, by_values, means = (
        torch.randn(*shape, generator=generator).to(device) for shape in ((count, 15, 3), (1, count, 3), (count, 3))
    )
    gradients = HarmonicsGradients(by_values, torch.zeros(1, 3, device=device), means, 3)
    whole, parts = ([start.clone(), *(torch.zeros_like(start) for _ in range(2))] for _ in range(2))
    never, changed = torch.zeros((), device=device), []
    for number in (1.0, 2.0, 3.0, 4.0):
        before, step = parts[0].clone(), torch.tensor(number, device=device)
        harmonics_adam_step(parts[0], 1, gradients, *parts[1:], step, never, rate=0.01, **OPTIONS, update_interval=2)
        changed.append((parts[0] != before).view(-1))
    # Blocks take turns, whatever the number of Gaussians; two steps of each are those of all.
    second = torch.arange(count * 45, device=device) // 1024 % 2 == 1
    assert torch.equal(changed[0], second) and torch.equal(changed[1], ~second)
    assert torch.equal(changed[2], second) and torch.equal(changed[3], ~second)
    for number in (1.0, 2.0):
        step = torch.tensor(number, device=device)
        harmonics_adam_step(whole[0], 1, gradients, *whole[1:], step, never, rate=0.01, **OPTIONS)
    for a, b in zip(whole, parts, strict=True):
        assert torch.allclose(a, b, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("usable", [0.0, 1.0])
def test_gradient_statistics_are_lengths_on_a_screen_of_two(device, usable):
    generator = torch.Generator().manual_seed(2)
    gradient = torch.randn(500, 2, generator=generator) * 10.0 ** (-30 * torch.rand(500, 1, generator=generator))
    gradient[:4] = torch.tensor([[0.0, 0.0], [1e-30, 0.0], [0.0, -1e-25], [3e-24, 4e-24]])
    radii = torch.randint(0, 3, (500,), generator=generator).float()
    sums = torch.full((500,), 0.5, device=device), torch.zeros(500, device=device)
    applied = torch.tensor(usable, device=device)
    add_gradient_statistics(gradient.to(device), radii.to(device), applied, 200, 100, *sums)
    length = torch.hypot(gradient[:, 0] * 100, gradient[:, 1] * 50)
    counted = (radii > 0) * usable
    torch.testing.assert_close(sums[0].cpu(), 0.5 + counted * length, rtol=1e-6, atol=0)
    assert torch.equal(sums[1].cpu(), counted)


def noise(device, opacity, seed=3, quaternion=(1.0, 0.0, 0.0, 0.0), scales=(0.3, 0.1, 0.02), mean=0.0, **bounds):
    """[COUNT, 3] what is added to positions at (mean, 0, 0)."""
    means = torch.zeros(COUNT, 3, device=device)
    means[:, 0] = mean
    add_position_noise(
        means,
        torch.tensor(scales, device=device).log().repeat(COUNT, 1),
        torch.tensor(quaternion, device=device).repeat(COUNT, 1),
        torch.full((COUNT,), math.log(opacity / (1 - opacity)), device=device),
        strength=STRENGTH,
        seed=seed,
        **bounds,
    )
    means[:, 0] -= mean
    return means.cpu()


def test_noise_is_normal_and_shaped_by_the_covariance(device):
    offsets = noise(device, 0.001)
    # Equation 8: the sigmoid of 100 (0.005 - 0.001), times R S S R^T.
    expected = STRENGTH / (1 + math.exp(-0.4)) * torch.tensor([0.09, 0.01, 0.0004])
    torch.testing.assert_close(offsets.std(0), expected, rtol=0.02, atol=0)
    assert (offsets.mean(0).abs() < 5 * expected / COUNT**0.5).all()
    unit = offsets / offsets.std(0)
    assert abs(float((unit**4).mean()) - 3) < 0.1 and (unit.T @ unit / COUNT - torch.eye(3)).abs().max() < 0.02


def test_noise_turns_with_the_gaussian(device):
    half = math.sqrt(0.5)
    turned = noise(device, 0.001, quaternion=(2 * half, 0.0, 0.0, 2 * half))  # a quarter turn about z, of length 2
    torch.testing.assert_close(turned.std(0), noise(device, 0.001).std(0)[[1, 0, 2]], rtol=0.02, atol=0)


def test_noise_of_far_gaussians_depends_on_the_angle_that_they_cover(device):
    near = noise(device, 0.001, mean=1.0)
    far = noise(device, 0.001, mean=64.0, scales=(64 * 0.3, 64 * 0.1, 64 * 0.02))
    torch.testing.assert_close(far.std(0), 64 * near.std(0), rtol=0.02, atol=0)


def test_noise_is_bounded_by_the_size_of_a_gaussian(device):
    scales = (1e4, 10.0, 1e-3)
    moved = noise(device, 0.001, scales=scales, most_sizes=0.2)
    strong = 0.2 * torch.tensor(scales)
    torch.testing.assert_close(moved.std(0)[:2], strong[:2], rtol=0.02, atol=0)
    torch.testing.assert_close(moved.std(0)[2], noise(device, 0.001, scales=scales).std(0)[2], rtol=0.02, atol=0)


def test_noise_moves_nothing_out_of_reach(device):
    moved = noise(device, 0.001, mean=9.0, scales=(5.0, 0.1, 0.1), most_distance=10.0)
    assert (moved[:, 0] + 9).abs().max() <= 10 and moved.abs().max() > 0.5
    # What is beyond it, as in runs of other coordinates, comes nearer alone.
    outside = noise(device, 0.001, mean=50.0, scales=(5.0, 1e-6, 1e-6), most_distance=10.0)
    assert outside[:, 0].max() <= 0 and outside[:, 0].min() < 0


def test_noise_leaves_the_opaque(device):
    assert noise(device, 0.5).abs().max() < 1e-12
    assert noise(device, 1 - 1e-7, scales=(1e30, 1.0, 1e-30)).abs().max() == 0


def test_noise_repeats_with_the_seed_whatever_the_threads(device, monkeypatch):
    monkeypatch.setenv("SEHDR_THREADS", "1")
    one = noise(device, 0.002)
    monkeypatch.setenv("SEHDR_THREADS", "3")
    assert torch.equal(one, noise(device, 0.002))
    torch.testing.assert_close(one, noise("cpu", 0.002), rtol=1e-4, atol=1e-7)
    assert not torch.equal(one, noise(device, 0.002, seed=4))
