"""Adaptive density control and MCMC relocation: who grows, who goes, and what stays the same."""

import math
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.model.gaussians import PARAMETER_NAMES, Gaussians, rotate
from sehdr_warp.rasterizer import rasterize
from sehdr_warp.rasterizer.ops.relocation import relocation_sums
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.strategies import Seeds, make_strategy, mcmc
from sehdr_warp.training.strategies.adc import split
from sehdr_warp.training.strategies.mcmc import sample_rows


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


def mcmc_strategy(*, cap_max=None, **options):
    values = {"densification.strategy": "mcmc"} | {f"mcmc.{name}": value for name, value in options.items()}
    values |= {} if cap_max is None else {"densification.cap_max": cap_max}
    return make_strategy(load_config("default", values), 10**6)


def test_relocation_sums_are_equation_9():
    sums, opacity = relocation_sums(torch.device("cpu")), 0.3
    for n in (1, 2, 5, 20):
        direct = sum(
            math.comb(i - 1, k) * (-1) ** k * opacity ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, n + 1)
            for k in range(i)
        )
        powers = opacity ** torch.arange(1, sums.shape[1] + 1, dtype=torch.float64)
        assert float(sums[n - 1] @ powers) == pytest.approx(direct, rel=1e-9)


@pytest.fixture(params=[False, True], ids=["counted", "not waited for"])
def rooms(request, monkeypatch):
    """Numbers that the device alone knows: read, as on the CPU, or not, as on a GPU."""
    if request.param:
        monkeypatch.setattr(mcmc, "host_bound", lambda number, most: most)


def test_relocation_moves_the_dead_and_keeps_the_image(rooms):
    generator = torch.Generator().manual_seed(0)
    gaussians = cloud(8)
    gaussians.overwrite(
        {"means": gaussians.means.detach() + torch.tensor([-0.5, -0.5, 4.0]), "log_scales": torch.full((8, 3), -2.0)}
    )
    logits = torch.logit(torch.tensor([0.004] * 3 + [0.5] * 5))
    gaussians.overwrite({"opacity_logits": logits})
    optimizer = adam(gaussians)
    gaussians.overwrite({"opacity_logits": logits})

    def image():
        features = gaussians.harmonics_dc[:, 0].detach()
        pose, intrinsics = torch.eye(4), torch.tensor([40.0, 40.0, 16.0, 16.0])
        with torch.no_grad():
            shapes = gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacities()
            return rasterize(*shapes, features, pose, intrinsics, 32, 32).image

    before, tensors = image(), dict(gaussians.named_parameters())
    # In place: what a recorded step holds of them stays good.
    assert not mcmc_strategy(growth_rate=0.0).refine(600, gaussians, optimizer, generator)
    assert all(gaussians.get_parameter(name) is parameter for name, parameter in tensors.items())
    after = image()
    assert gaussians.count == 8 and (gaussians.opacities() > 0.005).all()
    positions = {tuple(row) for row in gaussians.means.detach().tolist()}
    assert len(positions) == 5, "the three dead ones are where living ones are"
    # Plain copies would brighten the image by a quarter.
    assert (after - before).abs().mean() < 0.05 * before.abs().mean()


@pytest.mark.parametrize("cap", [40, 400])
def test_sources_of_copies_do_not_fade_before_a_photo_shows_them(cap):
    gaussians = cloud(40)
    optimizer = adam(gaussians)
    gaussians.overwrite({"opacity_logits": torch.tensor([-8.0] * 10 + [2.0] * 30)})
    strategy = mcmc_strategy(seed_fraction=0.0)
    strategy.cap_max = cap
    strategy.refine(600, gaussians, optimizer, torch.Generator().manual_seed(0))
    sources = optimizer.state[gaussians.means]["exp_avg"][:40].sum(1) == 0
    sources[:10] = False
    assert 0 < sources.sum() < 30
    before = gaussians.opacity_logits.detach()[:40].clone()
    for _ in range(20):  # Steps without a photo: the penalty alone has a gradient, far below that of photos.
        optimizer.zero_grad()
        gaussians.opacity_logits.grad = torch.full_like(gaussians.opacity_logits, 1e-6)
        optimizer.step()
    faded = before - gaussians.opacity_logits.detach()[:40]
    assert (faded[sources].abs() < 1e-3).all(), "about 0.01 in each step otherwise"


@pytest.mark.parametrize("large, density", [(True, 400.0), (True, 200.0), (False, 400.0)])
def test_copies_in_a_large_dense_scene_take_over_the_second_moments_of_their_source(large, density):
    gaussians = cloud(40)
    optimizer = adam(gaussians)
    gaussians.overwrite({"opacity_logits": torch.tensor([-8.0] * 10 + [2.0] * 30)})
    before = torch.arange(1.0, 41.0)
    optimizer.state[gaussians.means]["exp_avg_sq"][:] = before[:, None]
    options = {"densification.strategy": "mcmc", "mcmc.seed_fraction": 0.0, "mcmc.cap_density": density}
    dense = large and density > 300
    strategy = make_strategy(load_config("default", options), 10**6, large_scene=large)
    strategy.cap_max = 44 if dense else 40
    strategy.refine(600, gaussians, optimizer, torch.Generator().manual_seed(0))
    assert (gaussians.count > 40) == dense
    means, state = gaussians.means.detach(), optimizer.state[gaussians.means]
    copies = [*range(10), *range(40, gaussians.count)]
    sources = [10 + int((means[10:40] == means[copy]).all(1).nonzero()) for copy in copies]
    assert not state["exp_avg"][sources].any()
    assert (state["exp_avg_sq"][sources, 0] / before[sources] - (0.4 if dense else 0.1)).abs().max() < 1e-6
    if dense:
        assert not state["exp_avg"][copies].any()
        assert torch.equal(state["exp_avg_sq"][copies], state["exp_avg_sq"][sources])
    else:
        assert torch.equal(state["exp_avg_sq"][:10, 0], before[:10])


def proposer(colors):
    """A function that proposes Gaussians of these colors at the origin."""

    def propose(asked_count, room):
        proposed = cloud(len(colors)).tensors()
        dc = torch.tensor(colors)[:, None, None].expand(-1, 1, 3)
        proposed |= {"means": torch.zeros_like(proposed["means"]), "harmonics_dc": dc}
        rows = {name: values[:room].contiguous() for name, values in proposed.items()}
        return Seeds(rows, asked_count.clamp_max(len(colors)))

    return propose


@pytest.mark.parametrize(("dead", "colors"), [(6, 3), (2, 8), (0, 4), (9, 1), (10, 4)])
def test_the_born_come_first_and_take_the_places_of_the_dead(rooms, dead, colors):
    gaussians = cloud(10)
    optimizer = adam(gaussians)
    logits = torch.logit(torch.tensor([0.004] * dead + [0.5] * (10 - dead)))[torch.randperm(10)]
    gaussians.overwrite({"opacity_logits": logits})
    gone, before = (logits < -5).nonzero()[:, 0].tolist(), gaussians.rows(torch.arange(10))
    strategy = mcmc_strategy(seed_fraction=0.5, growth_rate=0.3)
    strategy.refine(
        600, gaussians, optimizer, torch.Generator().manual_seed(0), proposer([10.0 + k for k in range(colors)])
    )
    new = [] if dead == 10 else [10, 11, 12]  # Faint Gaussians do not become more.
    assert gaussians.count == 10 + len(new)
    places = [*gone, *new][: min(colors, (dead + len(new)) // 2)]
    colors_after = gaussians.harmonics_dc.detach()[:, 0, 0]
    assert colors_after[places].tolist() == [10.0 + k for k in range(len(places))]
    assert not gaussians.means.detach()[places].any()
    for name in PARAMETER_NAMES:
        assert not optimizer.state[getattr(gaussians, name)]["exp_avg"][places].any()
    if dead == 10:  # Nobody can be copied but the born.
        assert torch.equal(colors_after[gone[len(places) :]], before["harmonics_dc"][gone[len(places) :], 0, 0])
        return
    others = [place for place in [*gone, *new] if place not in places]
    survivors = [place for place in range(10) if place not in gone]
    sources = {tuple(row) for row in gaussians.means.detach()[[*survivors, *places]].tolist()}
    assert all(tuple(row) in sources for row in gaussians.means.detach()[others].tolist())
    assert (gaussians.opacities() > 0.005 - 1e-6).all()
    assert torch.equal(gaussians.means.detach()[survivors], before["means"][survivors])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="the CPU is never waited for")
def test_relocation_does_not_wait_for_a_gpu():
    for waited in ("first", "error"):  # What is made once may wait.
        gaussians = cloud(100).to("cuda:0")
        optimizer, generator = adam(gaussians), torch.Generator("cuda:0").manual_seed(0)
        gaussians.overwrite({"opacity_logits": torch.linspace(-6, 2, 100, device="cuda:0")})
        strategy = mcmc_strategy(cap_max=100)  # It waits only where the count grows.
        torch.cuda.set_sync_debug_mode(waited if waited == "error" else "default")
        try:
            strategy.refine(600, gaussians, optimizer, generator)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        assert gaussians.count == 100 and (gaussians.opacities() > 0.004).all()


def test_relocation_grows_to_the_budget(rooms):
    gaussians = cloud(100)
    optimizer = adam(gaussians)
    gaussians.overwrite({"opacity_logits": torch.zeros(100)})
    strategy = mcmc_strategy(cap_max=104)
    strategy.refine(600, gaussians, optimizer, torch.Generator().manual_seed(0))
    assert gaussians.count == 104
    strategy.refine(700, gaussians, optimizer, torch.Generator().manual_seed(0))
    assert gaussians.count == 104
    # 0.106 Gaussians for each of 1000, the square root of 10^6 pixels.
    strategy = mcmc_strategy(cap_density=0.106)
    strategy.refine(600, gaussians, optimizer, torch.Generator().manual_seed(0))
    assert gaussians.count == 106


@pytest.mark.parametrize("iterations", [300, 1500, 30_000])
def test_a_training_of_any_length_reaches_its_budget(iterations):
    strategy = make_strategy(load_config("default", {"schedule.iterations": iterations}), 10**6)
    assert strategy.cap_max == 120_000
    count = 5000
    for iteration in range(1, iterations + 1):
        if strategy.is_due(iteration):
            growth = strategy.next_count(iteration, count) / count
            assert iterations < 30_000 or growth <= 1.05 + 1 / count
            count = strategy.next_count(iteration, count)
    assert count == 120_000


def test_faint_gaussians_do_not_become_more():
    """Without this, photos that contradict each other end in a scene whose Gaussians are all dead."""
    counts = []
    for opacity in (0.01, 0.0306, 0.5):
        gaussians = cloud(100)
        gaussians.overwrite({"opacity_logits": torch.full((100,), opacity).logit()})
        mcmc_strategy(cap_max=1000).refine(600, gaussians, adam(gaussians), torch.Generator().manual_seed(0))
        counts.append(gaussians.count)
    assert counts[0] == 100 < counts[1] < counts[2] == 105


def test_noise_comes_with_the_iteration():
    moved = []
    for iteration in (7, 7, 8):
        gaussians = cloud(50)
        gaussians.overwrite({"opacity_logits": torch.full((50,), -6.0)})
        before = gaussians.means.detach().clone()
        mcmc_strategy(noise_lr=1.0).inject_noise(iteration, gaussians, 1.0)
        moved.append(gaussians.means.detach() - before)
    assert torch.equal(moved[0], moved[1]) and not torch.allclose(moved[0], moved[2])
    still = cloud(50)
    mcmc_strategy(noise_lr=0.0).inject_noise(7, still, 1.0)
    assert torch.equal(still.means, cloud(50).means)


def test_draws_follow_the_weights():
    sampled = sample_rows(torch.tensor([1.0, 0.0, 3.0]), 40_000, torch.Generator().manual_seed(0))
    counts = torch.bincount(sampled.rows, minlength=3) / 40_000
    torch.testing.assert_close(counts, torch.tensor([0.25, 0.0, 0.75]), atol=0.01, rtol=0)
