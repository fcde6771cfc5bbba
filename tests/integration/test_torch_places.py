"""Unusual places of torch: tensors without memory, tracing, hooks for saved tensors, one graph in several threads."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd import graph

from sehdr_warp.compat.gsplat import rasterization
from sehdr_warp.rasterizer import rasterize, spherical_harmonics, ssim
from tests.compat.gsplat.scenes import scene
from tests.rasterizer.test_torch_contract import HEIGHT, WIDTH, splats


def draw(*leaves):
    return rasterize(*leaves, WIDTH, HEIGHT).image


def draw_as_gsplat(*leaves):
    return rasterization(*leaves, **scene()[1]._asdict(), absgrad=True)[0]


def calls():
    return [(draw, splats(dtype=torch.float32)), (draw_as_gsplat, scene(count=40)[0])]


@pytest.mark.filterwarnings("error")
def test_tensors_without_memory_are_refused_and_leave_nothing_behind():
    """A kernel that reads address 0 ends the process."""
    leaves, place = scene(count=4173)  # A number of rows that no other test has, so its ranges are made here.
    with FakeTensorMode() as mode:
        with pytest.raises(TypeError, match="a is a FakeTensor, which has no memory"):
            ssim(torch.ones(12, 12, 3), torch.ones(12, 12, 3))
        without_memory = place._replace(viewmats=mode.from_tensor(place.viewmats), Ks=mode.from_tensor(place.Ks))
        with pytest.raises(TypeError, match="means is a FakeTensor, which has no memory"):
            rasterization(*map(mode.from_tensor, leaves), **without_memory._asdict())
        with pytest.raises(TypeError, match="opacities is a FakeTensor, which has no memory"):
            draw(*map(mode.from_tensor, splats(dtype=torch.float32)))
        with pytest.raises(TypeError, match="coefficients is a FakeTensor, which has no memory"):
            spherical_harmonics(1, torch.ones(5, 4, 3), torch.ones(5, 3), torch.zeros(3))
    assert rasterization(*leaves, **place._asdict())[0].isfinite().all()


@pytest.mark.parametrize("call", [0, 1], ids=["rasterize", "rasterization"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")
def test_tracing_is_refused_by_a_sentence(call):
    function, leaves = calls()[call]
    with pytest.raises(NotImplementedError, match=r"cannot be traced by torch\.jit; use torch\.compile"):
        torch.jit.trace(function, tuple(leaf.detach() for leaf in leaves))


@pytest.mark.parametrize("call", [0, 1], ids=["rasterize", "rasterization"])
def test_saved_tensors_can_be_stored_elsewhere(call):
    function, leaves = calls()[call]
    truth = torch.autograd.grad(function(*leaves).square().sum(), leaves)
    stored = []
    hooks = graph.saved_tensors_hooks(lambda tensor: stored.append(1) or tensor.clone(), lambda tensor: tensor)
    for context in (hooks, graph.save_on_cpu()):
        with context:
            image = function(*leaves)
        assert all(map(torch.equal, torch.autograd.grad(image.square().sum(), leaves), truth))
    assert len(stored) > len(leaves)


@pytest.mark.parametrize("call", [0, 1], ids=["rasterize", "rasterization"])
def test_threads_differentiate_one_graph_at_the_same_time(call):
    function, leaves = calls()[call]
    loss = function(*leaves).square().sum()
    truth = torch.autograd.grad(loss, leaves, retain_graph=True)
    with ThreadPoolExecutor(4) as pool:
        for results in pool.map(lambda _: torch.autograd.grad(loss, leaves, retain_graph=True), range(8)):
            assert all(map(torch.equal, results, truth))
