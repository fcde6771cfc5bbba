"""Gaussians: start values, and changes of their number that carry Adam's state."""

import math

import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.gaussians import HARMONIC_0, PARAMETER_NAMES, Gaussians


def grid(side=3):
    axis = torch.arange(float(side))
    return torch.cartesian_prod(axis, axis, axis)


def adam(gaussians):
    groups = [{"name": name, "params": [getattr(gaussians, name)]} for name in PARAMETER_NAMES]
    optimizer = torch.optim.Adam(groups, lr=0.1)
    sum(
        (
            getattr(gaussians, name)
            * torch.arange(1.0, gaussians.count + 1).reshape(-1, *[1] * (getattr(gaussians, name).dim() - 1))
        ).sum()
        for name in PARAMETER_NAMES
    ).backward()
    optimizer.step()
    return optimizer


def test_start_values():
    points = grid()
    dc = torch.rand(27, 3)
    gaussians = Gaussians.from_points(points, dc, 3, opacity=0.1, scale=0.5)
    # Each point of a unit grid has three neighbours at distance 1.
    torch.testing.assert_close(gaussians.log_scales.detach(), torch.full((27, 3), math.log(0.5)))
    torch.testing.assert_close(gaussians.opacities().detach(), torch.full((27,), 0.1))
    torch.testing.assert_close(gaussians.harmonics_dc.detach()[:, 0] * HARMONIC_0, dc)
    assert gaussians.harmonics_rest.shape == (27, 15, 3) and not gaussians.harmonics_rest.any()
    assert gaussians.degree == 3


@pytest.mark.parametrize("count", [1, 2, 4, 30])
def test_few_and_coinciding_points_have_finite_sizes(count):
    gaussians = Gaussians.from_points(torch.zeros(count, 3), torch.zeros(count, 3), 0)
    assert torch.isfinite(gaussians.log_scales).all()
    spread = Gaussians.from_points(
        torch.cat([torch.zeros(count, 3), torch.full((1, 3), 1e6)]), torch.zeros(count + 1, 3), 0
    )
    assert torch.isfinite(spread.log_scales).all()


def test_points_that_are_not_finite_are_named():
    points = grid()
    points[4, 1] = math.nan
    with pytest.raises(SehdrError, match="point 4 of 27 .* needs finite coordinates"):
        Gaussians.from_points(points, torch.zeros(27, 3), 0)


def test_keep_and_append_carry_adams_state():
    gaussians = Gaussians.from_points(grid(2), torch.rand(8, 3), 1)
    optimizer = adam(gaussians)
    moments = {name: optimizer.state[getattr(gaussians, name)]["exp_avg"].clone() for name in PARAMETER_NAMES}
    before = gaussians.rows(torch.arange(8))
    gaussians.keep_only(torch.tensor([5, 1, 2]), optimizer)
    gaussians.append(gaussians.rows(torch.tensor([0])), optimizer)
    for name in PARAMETER_NAMES:
        parameter = getattr(gaussians, name)
        torch.testing.assert_close(parameter.detach(), before[name][[5, 1, 2, 5]])
        state = optimizer.state[parameter]
        torch.testing.assert_close(state["exp_avg"][:3], moments[name][[5, 1, 2]])
        assert not state["exp_avg"][3].any() and not state["exp_avg_sq"][3].any() and float(state["step"]) == 1
    assert len(optimizer.state) == len(PARAMETER_NAMES)
    assert [p is getattr(gaussians, g["name"]) for g in optimizer.param_groups for p in g["params"]] == [True] * 6


def test_reserved_rows_keep_gaussians_where_they_are_and_change_nothing_else():
    plain, roomy = (Gaussians.from_points(grid(2), torch.zeros(8, 3), 1) for _ in range(2))
    optimizers = adam(plain), adam(roomy)
    roomy.reserve(11, optimizers[1])
    moves = roomy.reallocations
    with roomy.all_rows(optimizers[1]):
        held = {name: getattr(roomy, name).data_ptr() for name in PARAMETER_NAMES}
        assert roomy.means.shape == (11, 3) and roomy.active_count.tolist() == [8]
    for change in (
        lambda g, o: g.keep_only(torch.tensor([5, 1, 2, 7, 0, 3]), o),
        lambda g, o: g.append(g.rows(torch.tensor([0, 4, 4])), o),
        lambda g, o: g.overwrite({"opacity_logits": torch.full((9,), 7.0)}, o),
        lambda g, o: g.keep_only(torch.arange(9) < 7, o),
        lambda g, o: g.resize(10, o),
    ):
        for gaussians, optimizer in zip((plain, roomy), optimizers, strict=True):
            change(gaussians, optimizer)
            for name in PARAMETER_NAMES:
                optimizer.state[getattr(gaussians, name)]["exp_avg"].add_(1)
        with roomy.all_rows(optimizers[1]):
            assert {name: getattr(roomy, name).data_ptr() for name in PARAMETER_NAMES} == held
            assert roomy.active_count.tolist() == [plain.count] and not roomy.opacities()[plain.count :].any()
            torch.testing.assert_close(roomy.quaternions[plain.count :].norm(dim=1), torch.ones(11 - plain.count))
            for group in optimizers[1].param_groups:
                (whole,) = group["params"]
                assert whole is getattr(roomy, group["name"]) and len(whole) == 11
                assert not optimizers[1].state[whole]["exp_avg_sq"][plain.count :].any()
        for name in PARAMETER_NAMES:
            ours, theirs = getattr(roomy, name), getattr(plain, name)
            assert torch.equal(ours, theirs) and ours.data_ptr() == held[name]
            for key, moment in optimizers[0].state[theirs].items():
                assert torch.equal(optimizers[1].state[ours][key], moment)
    assert roomy.reallocations == moves and len(optimizers[1].state) == len(PARAMETER_NAMES)
    roomy.append(roomy.rows(torch.tensor([0, 1])), optimizers[1])
    assert roomy.reallocations > moves and roomy.row_count == roomy.count == 12


def test_overwrite_forgets_what_it_wrote():
    gaussians = Gaussians.from_points(grid(2), torch.rand(8, 3), 0)
    optimizer = adam(gaussians)
    gaussians.overwrite({"opacity_logits": torch.arange(8.0)}, optimizer)
    assert gaussians.opacity_logits.tolist() == list(range(8))
    moments = (optimizer.state[getattr(gaussians, name)]["exp_avg"] for name in ("opacity_logits", "means"))
    assert [bool(moment.any()) for moment in moments] == [False, True]


def test_shapes_that_do_not_fit_are_refused():
    good = Gaussians.from_points(grid(2), torch.rand(8, 3), 1).tensors()
    with pytest.raises(ValueError, match="quaternions"):
        Gaussians(**good | {"quaternions": torch.zeros(8, 3)})
    with pytest.raises(ValueError, match="degrees"):
        Gaussians(**good | {"harmonics_rest": torch.zeros(8, 4, 3)})
