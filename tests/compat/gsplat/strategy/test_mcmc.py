"""MCMCStrategy beside what its paper says."""

import torch

from sehdr_warp.compat.gsplat import MCMCStrategy

from .test_base import Scene, model


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
