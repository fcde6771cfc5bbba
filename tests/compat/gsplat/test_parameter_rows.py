"""Rows of parameters and of their optimizers."""

import torch

from sehdr_warp.compat.gsplat.parameter_rows import change_rows, write_rows


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
