"""The CUDA block kernels; without a GPU in Warp's CPU block emulation, which tests their logic."""

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

from .test_blend_cpu import BOUNDS, assert_blend_is_the_reference, crowd, leaves_and_lists

THRESHOLD = 1.0 / 255.0


@pytest.fixture
def blocks(monkeypatch):
    """Switches block kernels on the CPU on; off again, because ordinary kernels must not run in blocks."""
    monkeypatch.setattr(blending, "blend_on_cpu", partial(blend_on_cuda, deterministic=False))
    monkeypatch.setattr(tile_lists, "lists_by_tile", tile_lists.sort_by_tile)

    def run(task):
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
        try:
            return task()
        finally:
            monkeypatch.setattr(wp.config, "enable_cpu_blocks", False)

    return run


def test_more_gradients_than_int32_counts_are_refused_in_a_fixed_order():
    transmittance = torch.ones(2, 2)
    lists = SimpleNamespace(intersection_count=1 << 28)
    backward = BlockBackward(torch.ones(1, 3), 3, lists, None, transmittance, transmittance, THRESHOLD, True)
    with pytest.raises(SehdrError, match="268435456 intersections with 3 channels have 2\\^31 gradients or more"):
        backward(torch.ones(2, 2, 3), None)


@pytest.mark.parametrize("dtype", BOUNDS, ids=["float64", "float32"])
@pytest.mark.parametrize("channels, deterministic", [(1, False), (3, False), (3, True), (9, False)])
def test_they_are_the_reference(blocks, device, dtype, channels, deterministic, monkeypatch):
    monkeypatch.setattr(blending, "blend_on_cpu", partial(blend_on_cuda, deterministic=deterministic))
    scene, run = crowd(channels), blocks if device == "cpu" else lambda task: task()
    ranges = leaves_and_lists(scene, THRESHOLD)[1].tile_ranges
    assert int((ranges[:, 1] - ranges[:, 0]).max()) > 64  # Queues spill over 32.
    assert_blend_is_the_reference(scene, dtype, device, run=run, deterministic=deterministic)


def test_a_single_pixels_gradient_may_have_any_strides(blocks):
    scene = crowd(1, width=1, height=1).to(torch.float32, "cpu")
    leaves, lists, splats = leaves_and_lists(scene, THRESHOLD)
    image = blocks(lambda: blend(leaves, lists, splats, THRESHOLD))[0]
    blocks(image.sum().backward)
    assert float(leaves.features.grad.sum()) > 0


def test_nothing_more_by_gaussian_is_kept_for_the_backward_pass(blocks, monkeypatch):
    monkeypatch.setenv("KINETO_LOG_LEVEL", "99")  # the profiler's own messages
    monkeypatch.setattr(blending_cuda, "MAX_SINGLE_SORT", 0)  # few are kept padded
    scene = crowd(3).to(torch.float32, "cpu")
    leaves, lists, splats = leaves_and_lists(scene, THRESHOLD)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        image = blocks(lambda: blend(leaves, lists, splats, THRESHOLD))[0]
    allocated = sum(event.nbytes() for event in recorded.profiler.kineto_results.events() if event.name() == "[memory]")
    by_pixel = 3 + 1 + 1  # image, transmittance and the last Gaussian drawn
    assert image.requires_grad and allocated == 4 * by_pixel * 44 * 26
