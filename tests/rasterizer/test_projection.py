"""The projection as a torch operation; what it computes is compared in tests/kernels."""

import gc
import weakref

import pytest
import torch

from sehdr_warp.rasterizer.projection import project_to_camera
from sehdr_warp.rasterizer.render_options import RenderOptions

from .scenes import random_scene

OPTIONS = 0.01, 0.3, 1 / 255  # near_plane, eps2d, alpha_threshold


def project_scene(device="cpu", **sizes):
    """The tensors that a projection takes, and what it returns."""
    scene = random_scene(**sizes).to(device=device)
    inputs = *scene.tensors[:4], *scene.tensors[5:]
    return inputs, project_to_camera(*inputs, RenderOptions(scene.width, scene.height, *OPTIONS))


def test_gradients_of_any_strides_are_read(device):
    weights = torch.tensor([2.0, 3.0, 5.0], dtype=torch.float64, device=device)
    grads = []
    for expanded in (True, False):
        inputs, (means2d, conics, depths, opacities, _) = project_scene(device)
        # The derivatives of a sum are one number that is there once, those of a product as many as there are.
        loss = means2d.sum() + (conics * weights).sum() + depths.sum() + opacities.sum()
        if not expanded:
            ones = torch.ones_like
            loss = (means2d * ones(means2d)).sum() + (conics * weights).sum()
            loss = loss + (depths * ones(depths)).sum() + (opacities * ones(opacities)).sum()
        loss.backward()
        grads.append([tensor.grad for tensor in inputs])
    for ours, theirs in zip(*grads, strict=True):
        assert ours.abs().sum() > 0
        torch.testing.assert_close(ours, theirs)


def test_only_what_asks_for_a_gradient_has_one(device):
    inputs, (means2d, *_) = project_scene(device)
    by_scales, by_pose = torch.autograd.grad(means2d.square().sum(), (inputs[0], inputs[4]))
    assert by_scales.shape == inputs[0].shape and by_pose.shape == (4, 4)
    assert all(tensor.grad is None for tensor in inputs)
    with torch.no_grad():
        assert not project_scene(device)[1][0].requires_grad
    assert not project_scene(device)[1][4].requires_grad


def test_the_cameras_gradient_is_of_all_gaussians(device):
    """However many threads share them: each adds to the same numbers."""
    inputs, (means2d, *_, extents) = project_scene(device, count=40_000, size=0.01)
    means2d.sum().backward()
    visible = (extents[:, 0] > 0).sum()
    assert visible > 20_000
    by_lens = inputs[5].grad
    assert by_lens is not None
    torch.testing.assert_close(by_lens[2:], visible.double().expand(2))


@pytest.mark.parametrize("differentiated", [False, True], ids=["dropped", "differentiated"])
def test_memory_goes_without_the_garbage_collector(device, differentiated):
    gc.disable()
    try:
        inputs, results = project_scene(device)
        alive = [weakref.ref(tensor) for tensor in results]
        if differentiated:
            results[0].sum().backward()
        del inputs, results
        assert [tensor() for tensor in alive] == [None] * 5
    finally:
        gc.enable()
