"""Trainings with strategies as gsplat's examples make them, and what strategies refuse."""

import pytest
import torch

from sehdr_warp.compat.gsplat import DefaultStrategy, MCMCStrategy, rasterization

from ..scenes import COUNT, scene


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
