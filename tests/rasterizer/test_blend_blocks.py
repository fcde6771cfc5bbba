"""The CUDA block kernels run in Warp's CPU block emulation, so that a machine without a GPU tests their logic."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from torch.profiler import ProfilerActivity, profile

from sehdr_warp.errors import SehdrError
from sehdr_warp.rasterizer import blending, blending_cuda, tile_lists
from sehdr_warp.rasterizer.blending import blend
from sehdr_warp.rasterizer.blending_cuda import BlockBackward, blend_on_cuda
from sehdr_warp.rasterizer.projection import Splats2D
from sehdr_warp.rasterizer.reference import blend_reference
from sehdr_warp.rasterizer.tile_lists import build_tile_lists, order_gaussians

from .scenes import packed, projected, random_like, random_scene, relative_error

THRESHOLD = 1.0 / 255.0
BOUNDS = {torch.float64: 1e-12, torch.float32: 1e-5}


@pytest.fixture
def blocks(monkeypatch):
    """Switches block kernels on the CPU on; off again, because ordinary kernels must not run in blocks."""
    monkeypatch.setattr(blending, "blend_on_cpu", partial(blend_on_cuda, deterministic=False))
    monkeypatch.setattr(tile_lists, "lists_by_tile", tile_lists._sort_by_tile)

    def run(task):
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
        try:
            return task()
        finally:
            monkeypatch.setattr(wp.config, "enable_cpu_blocks", False)

    return run


def leaves_and_lists(scene):
    """Return arguments of blend(): splats whose tensors are leaves, lists and packed Gaussians."""
    gaussians, splats = projected(scene), packed(scene)
    order = order_gaussians(splats)
    lists = build_tile_lists(splats, order, scene.width, scene.height, keep_emit_order=True)
    leaves = [tensor.detach().requires_grad_() for tensor in (*gaussians, scene.tensors[4])]
    return Splats2D(*leaves), lists, splats


def test_more_gradients_than_int32_counts_are_refused_in_a_fixed_order():
    transmittance = torch.ones(2, 2)
    lists = SimpleNamespace(intersection_count=1 << 28)
    backward = BlockBackward(torch.ones(1, 3), 3, lists, None, transmittance, transmittance, THRESHOLD, True)
    with pytest.raises(SehdrError, match="268435456 intersections with 3 channels have 2\\^31 gradients or more"):
        backward(torch.ones(2, 2, 3), None)


@pytest.mark.parametrize("dtype", BOUNDS, ids=["float64", "float32"])
@pytest.mark.parametrize("channels, deterministic", [(1, False), (3, False), (3, True), (9, False)])
def test_block_kernels_match_the_reference(blocks, dtype, channels, deterministic, monkeypatch):
    monkeypatch.setattr(blending, "blend_on_cpu", partial(blend_on_cuda, deterministic=deterministic))
    # Enough overlap that queues spill over 32 and pixels finish early; a cut tile at the right and the bottom.
    scene = random_scene(count=600, channels=channels, width=44, height=26, spread=1.6, seed=2)
    leaves, lists, splats = leaves_and_lists(scene.to(dtype))
    ranges = lists.tile_ranges
    assert int((ranges[:, 1] - ranges[:, 0]).max()) > 64
    image, transmittance = blocks(lambda: blend(leaves, lists, splats, THRESHOLD, deterministic))
    truth = scene.to(torch.float64)
    true_leaves, _, _ = leaves_and_lists(truth)
    means2d, conics, depths, opacities, extents, features = true_leaves
    blended = means2d, conics, opacities, features, depths.detach(), extents.detach()
    true_image, true_transmittance = blend_reference(*blended, truth.width, truth.height, THRESHOLD)
    assert (true_transmittance < 0.001).any()
    assert relative_error(image, true_image) < BOUNDS[dtype]
    assert relative_error(transmittance, true_transmittance) < BOUNDS[dtype]
    assert relative_error(1 - transmittance, 1 - true_transmittance) < BOUNDS[dtype]
    loss = (image * random_like(image, 1)).sum() + (transmittance * random_like(transmittance, 2)).sum()
    blocks(loss.backward)
    true_loss = (true_transmittance * random_like(true_transmittance, 2)).sum()
    (true_loss + (true_image * random_like(true_image, 1)).sum()).backward()
    for name in ("means2d", "conics", "opacities", "features"):
        ours, true = getattr(leaves, name).grad, getattr(true_leaves, name).grad
        assert relative_error(ours, true) < BOUNDS[dtype]


def test_a_single_pixels_gradient_may_have_any_strides(blocks):
    scene = random_scene(count=600, channels=1, width=1, height=1, spread=1.6, seed=2).to(torch.float32, "cpu")
    leaves, lists, splats = leaves_and_lists(scene)
    image = blocks(lambda: blend(leaves, lists, splats, THRESHOLD))[0]
    blocks(image.sum().backward)
    assert float(leaves.features.grad.sum()) > 0


def test_nothing_more_by_gaussian_is_kept_for_the_backward_pass(blocks, monkeypatch):
    monkeypatch.setenv("KINETO_LOG_LEVEL", "99")  # the profiler's own messages
    monkeypatch.setattr(blending_cuda, "MAX_SINGLE_SORT", 0)  # few are kept padded
    scene = random_scene(count=600, channels=3, width=44, height=26, seed=2).to(torch.float32, "cpu")
    leaves, lists, splats = leaves_and_lists(scene)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        image = blocks(lambda: blend(leaves, lists, splats, THRESHOLD))[0]
    allocated = sum(event.nbytes() for event in recorded.profiler.kineto_results.events() if event.name() == "[memory]")
    by_pixel = 3 + 1 + 1  # image, transmittance and the last Gaussian drawn
    assert image.requires_grad and allocated == 4 * by_pixel * 44 * 26
