"""DefaultStrategy beside what its paper says."""

import math

import pytest
import torch

from sehdr_warp.compat.gsplat import DefaultStrategy, rasterization

from ..reference_state import reference_state
from ..scenes import scene
from .test_base import model


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
