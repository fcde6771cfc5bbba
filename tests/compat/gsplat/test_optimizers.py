"""SelectiveAdam beside the formula that it follows."""

import pytest
import torch

from sehdr_warp.compat.gsplat import SelectiveAdam


def test_only_visible_rows_and_their_moments_change():
    start = torch.arange(12.0).view(4, 3)
    parameter = torch.nn.Parameter(start.clone())
    optimizer = SelectiveAdam([{"params": [parameter], "lr": 0.1}], eps=1e-8, betas=(0.9, 0.99))
    expected, first, second = start.clone(), torch.zeros(4, 3), torch.zeros(4, 3)
    for step, visible in enumerate(([0, 2], [0, 1])):
        parameter.grad = torch.full((4, 3), step + 1.0)
        optimizer.step(torch.isin(torch.arange(4), torch.tensor(visible)))
        first[visible] = 0.9 * first[visible] + 0.1 * (step + 1)
        second[visible] = 0.99 * second[visible] + 0.01 * (step + 1) ** 2
        expected[visible] -= 0.1 * first[visible] / (second[visible].sqrt() + 1e-8)
        torch.testing.assert_close(parameter.detach(), expected)
    assert torch.equal(parameter.detach()[3], start[3])


def test_what_does_not_fit_is_named():
    parameters = [torch.nn.Parameter(torch.ones(4)) for _ in range(2)]
    with pytest.raises(ValueError, match="a group has 2 parameters, expected 1"):
        SelectiveAdam(parameters, eps=1e-8, betas=(0.9, 0.99)).step(torch.ones(4))
    parameters[0].grad = torch.ones(4)
    with pytest.raises(ValueError, match=r"visibility has shape \[3\], but a parameter \[4\]"):
        SelectiveAdam(parameters[:1], eps=1e-8, betas=(0.9, 0.99)).step(torch.ones(3))
    with pytest.raises(TypeError, match="visibility is a list, expected a tensor"):
        SelectiveAdam(parameters[:1], eps=1e-8, betas=(0.9, 0.99)).step([True] * 4)
