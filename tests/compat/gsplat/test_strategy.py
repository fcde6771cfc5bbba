"""Strategies beside what their papers say, and trainings with them as gsplat's examples make them."""

import math

import pytest
import torch

from sehdr_warp.compat.gsplat import DefaultStrategy, MCMCStrategy, compute_relocation, rasterization
from sehdr_warp.compat.gsplat.parameter_rows import change_rows, write_rows
from sehdr_warp.compat.gsplat.strategy import ops

from .reference_state import reference_state
from .scenes import COUNT, scene


def model(device="cpu", count=COUNT):
    truth, place = scene(device, count)
    photos = rasterization(*truth, **place._asdict())[0].detach()
    generator = torch.Generator().manual_seed(1)
    means = truth[0].detach() + 0.05 * torch.randn(count, 3, generator=generator).to(device)
    values = {
        "means": means,
        "quats": truth[1].detach().clone(),
        "scales": torch.full_like(means, -2.5),
        "opacities": torch.zeros(count, device=device),
        "colors": torch.full_like(means, 0.5),
    }
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
    optimizers = {name: torch.optim.Adam([{"params": p, "lr": 0.01, "name": name}]) for name, p in params.items()}
    return params, optimizers, place, photos


class Scene:
    """Rows of a tensor that follow the Gaussians, as GaussianScene of gsplat 1.6 has them."""

    def __init__(self, rows):
        self.rows = rows

    def on_duplicate(self, sel):
        self.rows = torch.cat([self.rows, self.rows[sel]])

    def on_split(self, sel, rest):
        self.rows = torch.cat([self.rows[rest], self.rows[sel], self.rows[sel]])

    def on_remove(self, remove_mask):
        self.rows = self.rows[~remove_mask]

    def on_relocate(self, dead_indices, sampled_indices):
        self.rows[dead_indices] = self.rows[sampled_indices]

    def on_sample_add(self, sampled_indices):
        self.rows = torch.cat([self.rows, self.rows[sampled_indices]])


STRATEGIES = {
    "default": DefaultStrategy(refine_start_iter=10, refine_every=10, reset_every=1000, grow_grad2d=1e-5),
    "absgrad": DefaultStrategy(
        refine_start_iter=10, refine_every=10, reset_every=1000, grow_grad2d=2e-5, absgrad=True, revised_opacity=True,
        refine_scale2d_stop_iter=20, prune_scale3d=1.0,
    ),
    "mcmc": MCMCStrategy(refine_start_iter=10, refine_every=10, cap_max=230),
}  # fmt: skip


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("name", list(STRATEGIES))
def test_a_training_as_gsplats_simple_trainer_makes_one(name, packed, device):
    torch.manual_seed(0)
    params, optimizers, place, photos = model(device)
    strategy = STRATEGIES[name]
    strategy.check_sanity(params, optimizers)
    is_default = isinstance(strategy, DefaultStrategy)
    state = strategy.initialize_state(scene_scale=1.0) if is_default else strategy.initialize_state()
    losses, counts = [], []
    scene = Scene(torch.arange(float(COUNT), device=device))
    params["origins"] = torch.nn.Parameter(scene.rows.clone(), requires_grad=False)
    for step in range(60):
        colors, alphas, info = rasterization(
            means=params["means"], quats=params["quats"], scales=torch.exp(params["scales"]),
            opacities=torch.sigmoid(params["opacities"]), colors=params["colors"],
            viewmats=place[0], Ks=place[1], width=place[2], height=place[3],
            packed=packed, absgrad=is_default and strategy.absgrad, sparse_grad=False, rasterize_mode="classic",
            distributed=False, camera_model="pinhole", with_ut=False, with_eval3d=False,
        )  # fmt: skip
        strategy.step_pre_backward(params=params, optimizers=optimizers, state=state, step=step, info=info)
        loss = (colors - photos).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        arguments = {"params": params, "optimizers": optimizers, "state": state, "step": step, "info": info}
        if isinstance(strategy, DefaultStrategy):
            strategy.step_post_backward(**arguments, packed=packed, scene=scene)
        else:
            strategy.step_post_backward(**arguments, lr=1e-6, scene=scene)
        assert torch.equal(scene.rows, params["origins"])
        losses.append(float(loss.detach()))
        counts.append(len(params["means"]))
        assert all(len(value) == counts[-1] for value in params.values())
        assert alphas.shape[-1] == 1
    assert losses[-1] < 0.5 * losses[0]
    assert counts[-1] != COUNT and (name != "mcmc" or counts[-1] == 230)


@pytest.mark.parametrize("name", ["default", "mcmc"])
def test_a_subclass_overrides_steps_by_gsplats_names(name):
    """Override a step with the arguments of gsplat 1.5, which has no scenes."""
    calls = []

    class Default(DefaultStrategy):
        def _update_state(self, params, state, info, packed=False):
            calls.append("update")
            super()._update_state(params, state, info, packed=packed)

        def _grow_gs(self, params, optimizers, state, step):
            calls.append("grow")
            return super()._grow_gs(params, optimizers, state, step)

        def _prune_gs(self, params, optimizers, state, step):
            calls.append("prune")
            return super()._prune_gs(params, optimizers, state, step)

    class Mcmc(MCMCStrategy):
        def _relocate_gs(self, params, optimizers, binoms):
            calls.append("relocate")
            assert [int(binoms[n, 2]) for n in (1, 2, 3, 50)] == [0, 1, 3, 1225] and binoms.shape == (51, 51)
            return super()._relocate_gs(params, optimizers, binoms)

        def _add_new_gs(self, params, optimizers, binoms):
            calls.append("add")
            return super()._add_new_gs(params, optimizers, binoms)

    params, optimizers, place, _ = model()
    own = [params[key] for key in ("means", "quats", "scales", "opacities", "colors")]
    image, _, info = rasterization(*own[:2], own[2].exp(), own[3].sigmoid(), own[4], **place._asdict())
    options = {"refine_start_iter": 0, "refine_every": 1}
    strategy, extra = (Mcmc(**options), {"lr": 0.0}) if name == "mcmc" else (Default(**options), {"packed": True})
    state = strategy.initialize_state()
    strategy.step_pre_backward(params, optimizers, state, 1, info)
    image.mean().backward()
    strategy.step_post_backward(params, optimizers, state, 1, info, **extra)
    assert calls == (["relocate", "add"] if name == "mcmc" else ["update", "grow", "prune"])


def test_operations_of_strategies_alone_change_statistics_too():
    params, optimizers, _, _ = model(count=4)
    means, state = params["means"].detach().clone(), {"age": torch.tensor([1.0, 2.0, 3.0, 4.0])}
    mask = torch.tensor([False, True, False, False])
    ops.duplicate(params=params, optimizers=optimizers, state=state, mask=mask)
    ops.remove(params=params, optimizers=optimizers, state=state, mask=torch.tensor([True, False, False, False, False]))
    assert torch.equal(params["means"].detach(), means[[1, 2, 3, 1]]) and state["age"].tolist() == [2, 3, 4, 2]
    ops.split(params=params, optimizers=optimizers, state=state, mask=mask, revised_opacity=True)
    assert state["age"].tolist() == [2, 4, 2, 3, 3]
    together = 1 - (1 - params["opacities"].detach().sigmoid()[3:]).prod()
    assert float(together) == pytest.approx(0.5)
    ops.reset_opa(params=params, optimizers=optimizers, state=state, value=0.1)
    assert float(params["opacities"].detach().sigmoid().max()) == pytest.approx(0.1)
    ops.sample_add(params, optimizers, state, n=2)
    assert state["age"].tolist() == [2, 4, 2, 3, 3, 0, 0]
    params["opacities"].data[:3], state["age"], state["binoms"] = -20.0, torch.arange(1.0, 8.0), torch.ones(5, 5)
    ops.relocate(params, optimizers, state, mask=params["opacities"].detach() < -9)
    assert bool(state["binoms"].all())
    assert state["age"][:3].tolist() == [1, 2, 3] and bool((state["age"][3:] == 0).any())


@pytest.mark.parametrize("operation", [ops.duplicate, ops.split, ops.remove, ops.relocate])
def test_what_is_no_mask_or_opacity_is_named(operation):
    params, optimizers, _, _ = model(count=4)
    for mask, message in (
        (torch.tensor([1, 0, 0, 0]), r"mask is torch\.int64, expected torch\.bool"),
        (torch.ones(3, dtype=torch.bool), r"mask has shape \[3\], expected \[4\]"),
        ([True] * 4, "mask is a list"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            operation(params, optimizers, {}, mask)
    with pytest.raises(ValueError, match="value 1.2 is not above 0 and at most 1"):
        ops.reset_opa(params, optimizers, {}, 1.2)


def test_relocated_gaussians_look_as_the_one_did():
    """Equation 9: n Gaussians one behind another have the opacity of the one, and its integral over a line."""
    opacities, scales = torch.tensor([0.3, 0.9, 0.6]), torch.ones(3, 3)
    ratios = torch.tensor([1, 2, 5])
    shared, sizes = compute_relocation(opacities, scales, ratios)
    fewer, _ = compute_relocation(opacities, scales, ratios, torch.zeros(2, 2))
    assert torch.equal(fewer[:2], shared[:2]) and float(fewer[2]) == pytest.approx(1 - math.sqrt(0.4))
    torch.testing.assert_close(1 - (1 - shared) ** ratios, opacities)
    assert float(sizes[0, 0]) == pytest.approx(1.0)
    x = torch.linspace(-12, 12, 20001, dtype=torch.float64)
    for opacity, own, size, ratio in zip(opacities, shared, sizes[:, 0], ratios, strict=True):
        one = (opacity * torch.exp(-(x**2) / 2)).sum()
        alpha = own.double() * torch.exp(-((x / size.double()) ** 2) / 2)
        together = (1 - (1 - alpha) ** int(ratio)).sum()
        assert float(together / one) == pytest.approx(1, rel=1e-4)


def test_transparent_gaussians_move_to_opaque_ones():
    torch.manual_seed(0)
    params, optimizers, _, _ = model(count=6)
    params["opacities"].data = torch.tensor([0.001, 0.6, 0.001, 0.7, 0.8, 0.001]).logit()
    sum(value.sum() for value in params.values()).backward()
    for optimizer in optimizers.values():
        optimizer.step()
    before, rows = params["means"].detach().clone(), Scene(torch.arange(6))
    strategy = MCMCStrategy(cap_max=6, noise_lr=0.0)
    strategy.step_post_backward(params, optimizers, {}, 600, {}, lr=0.1, scene=rows)
    dead, sources = torch.tensor([0, 2, 5]), rows.rows[[0, 2, 5]]
    assert set(sources.tolist()) <= {1, 3, 4} and rows.rows[[1, 3, 4]].tolist() == [1, 3, 4]
    assert torch.equal(params["means"].detach(), before[rows.rows])
    shared = params["opacities"].detach().sigmoid()
    assert torch.equal(shared[dead], shared[sources]) and bool((shared > 0.3).all())
    moments = optimizers["means"].state[params["means"]]["exp_avg"]
    assert not moments[sources].any()


def test_large_gaussians_are_pruned_after_the_first_reset():
    params, optimizers, _, _ = model(count=3)
    params["scales"].data[1] = math.log(0.3)
    strategy = DefaultStrategy(refine_every=1, refine_start_iter=0, reset_every=2, prune_scale3d=0.1, prune_opa=0.001)
    means2d = torch.zeros(1, 3, 2, requires_grad=True)
    means2d.grad = torch.zeros(1, 3, 2)
    info = {"means2d": means2d, "radii": torch.ones(1, 3, 2, dtype=torch.int32)}
    info |= {"width": 10, "height": 10, "n_cameras": 1}
    state, others = strategy.initialize_state(), params["means"].detach()[[0, 2]].clone()
    strategy.step_post_backward(params, optimizers, state, 1, info)
    assert len(params["means"]) == 3
    strategy.step_post_backward(params, optimizers, state, 3, info)
    assert torch.equal(params["means"].detach(), others)


@pytest.mark.parametrize("absgrad, remedy", [(False, r"call step_pre_backward\(\)"), (True, "absgrad=True")])
def test_a_step_without_gradients_says_what_is_missing(absgrad, remedy):
    params, optimizers, _, _ = model(count=3)
    info = {"means2d": torch.zeros(1, 3, 2, requires_grad=True), "n_cameras": 1}
    strategy = DefaultStrategy(absgrad=absgrad)
    with pytest.raises(ValueError, match=rf"'means2d'\] has no gradient; .*{remedy}"):
        strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, info)


def test_noise_fades_with_the_opacity_and_ends():
    params, optimizers, _, _ = model(count=2)
    params["opacities"].data = torch.tensor([0.1, 0.4]).logit()
    params["scales"].data.zero_()
    options = {"noise_opacity_t": 0.1, "noise_opacity_k": 20.0, "noise_lr": 1.0}
    moved = []
    for strategy in (MCMCStrategy(**options), MCMCStrategy(**options, noise_injection_stop_iter=7)):
        before = params["means"].detach().clone()
        torch.manual_seed(0)
        strategy.step_post_backward(params, optimizers, {}, 7, {}, lr=0.1)
        moved.append(params["means"].detach() - before)
    torch.manual_seed(0)
    noise = 0.1 * torch.randn(2, 3) * torch.tensor([[0.5], [torch.sigmoid(torch.tensor(-6.0))]])
    torch.testing.assert_close(moved[0], noise, rtol=1e-4, atol=1e-6)
    assert not moved[1].any()


def test_rows_change_with_their_optimizers():
    params = {"means": torch.nn.Parameter(torch.arange(8.0).view(4, 2)), "fixed": torch.nn.Parameter(torch.ones(4))}
    params["fixed"].requires_grad_(False)
    optimizers = {"means": torch.optim.Adam([params["means"]])}
    params["means"].square().sum().backward()
    optimizers["means"].step()
    moment = optimizers["means"].state[params["means"]]["exp_avg"].clone()
    statistics = {"count": torch.arange(4.0), "scene_scale": 2.0}
    mask = torch.tensor([True, False, True, True])
    before = params["means"].detach().clone()
    more = {"means": torch.full((2, 2), 9.0), "fixed": torch.zeros(2)}
    change_rows(params, optimizers, statistics, mask, more, torch.tensor([0, 3]))
    assert torch.equal(params["means"].detach(), torch.cat([before[mask], more["means"]]))
    state = optimizers["means"].state[params["means"]]
    assert torch.equal(state["exp_avg"], torch.cat([moment[mask], torch.zeros(2, 2)])) and int(state["step"]) == 1
    assert optimizers["means"].param_groups[0]["params"] == [params["means"]] and not params["fixed"].requires_grad
    assert statistics["count"].tolist() == [0, 2, 3, 0, 3] and statistics["scene_scale"] == 2.0
    write_rows(params, optimizers, {"means": torch.zeros(5, 2)}, torch.tensor([0]))
    assert bool((state["exp_avg"][0] == 0).all()) and bool((state["exp_avg"][1] != 0).any())


def test_parts_of_a_split_lie_within_the_one_and_resets_lower_opacities():
    torch.manual_seed(0)
    params, optimizers, _, _ = model(count=1)
    params["scales"].data[:] = torch.tensor([0.0, -3.0, -3.0])
    strategy = DefaultStrategy(refine_every=1, refine_start_iter=0, reset_every=2, grow_scale3d=0.01, prune_scale3d=1e9)
    state = strategy.initialize_state()
    means2d = torch.zeros(1, 1, 2, requires_grad=True)
    means2d.grad = torch.ones(1, 1, 2)
    info = {
        "means2d": means2d,
        "radii": torch.ones(1, 1, 2, dtype=torch.int32),
        "width": 10,
        "height": 10,
        "n_cameras": 1,
    }
    axis = params["quats"].detach()
    strategy.step_post_backward(params, optimizers, state, 1, info)
    assert len(params["means"]) == 2 and torch.equal(params["quats"].detach(), axis.repeat(2, 1))
    torch.testing.assert_close(params["scales"].detach(), torch.tensor([[0.0, -3.0, -3.0]] * 2) - math.log(1.6))
    info["radii"] = torch.ones(1, 2, 2, dtype=torch.int32)
    info["means2d"] = torch.zeros(1, 2, 2, requires_grad=True)
    info["means2d"].grad = torch.zeros(1, 2, 2)
    strategy.step_post_backward(params, optimizers, state, 2, info)
    torch.testing.assert_close(params["opacities"].detach().sigmoid(), torch.full((2,), 0.01))


@pytest.mark.parametrize("strategy", [DefaultStrategy(), MCMCStrategy()])
def test_parameters_that_do_not_fit_are_named(strategy):
    params, optimizers, _, _ = model()
    del optimizers["quats"]
    with pytest.raises(ValueError, match="optimizers"):
        strategy.check_sanity(params, optimizers)
    params, optimizers, _, _ = model()
    del params["scales"], optimizers["scales"]
    with pytest.raises(ValueError, match="no parameter scales"):
        strategy.check_sanity(params, optimizers)
    params, optimizers, _, _ = model()
    optimizers["means"].add_param_group({"params": [torch.nn.Parameter(torch.zeros(1))]})
    with pytest.raises(ValueError, match="optimizer of means has 2 groups"):
        strategy.check_sanity(params, optimizers)


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("absgrad", [True, False])
def test_signals_of_densification_are_those_of_a_dense_render(absgrad, packed, device):
    """Two steps of both cameras, many Gaussians beyond the border, beside autograd over every pixel and Gaussian."""
    leaves, place = scene(device, count=120)
    means, quats, scales, opacities, colors = (leaf.detach().double() for leaf in leaves)
    place = place._replace(viewmats=place.viewmats.double(), Ks=place.Ks.double())
    values = {"means": 1.7 * means, "quats": quats, "scales": scales.log(), "opacities": opacities.logit()}
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
    strategy = DefaultStrategy(absgrad=absgrad, refine_scale2d_stop_iter=10)
    state, truth = strategy.initialize_state(), None
    for step in range(2):
        shapes = params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid()
        image, _, info = rasterization(*shapes, colors, **place._asdict(), packed=packed, absgrad=absgrad)
        strategy.step_pre_backward(params, {}, state, step, info)
        (image - 0.5).abs().mean().backward()
        strategy.step_post_backward(params, {}, state, step, info, packed=packed)
        own = reference_state([shape.detach() for shape in shapes], colors, place, absgrad=absgrad)
        truth = own if truth is None else own.after(truth)
        with torch.no_grad():
            params["means"][:, 0] += 0.05
    assert truth is not None and 0 < int((truth.count < 4).sum()) < 120 and int((truth.count == 0).sum()) > 0
    assert torch.equal(state["count"], truth.count)
    torch.testing.assert_close(state["grad2d"], truth.grad2d, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(state["radii"], truth.radii, rtol=1e-6, atol=1e-9)
