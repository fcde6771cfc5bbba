"""The CUDA block kernels run on CPU fibers, so that a machine without a GPU tests their logic."""

import weakref

import pytest
import torch
import warp as wp
from torch.profiler import ProfilerActivity, profile

from sehdr_warp.splatting import blending
from sehdr_warp.splatting.blending import blend, blend_on_cuda
from sehdr_warp.splatting.projection import project
from sehdr_warp.splatting.reference import blend_reference
from sehdr_warp.splatting.tile_lists import build_tile_lists, pack_records

from .scenes import random_like, random_scene, relative_error

BOUNDS = {torch.float64: (1e-12, 1e-12), torch.float32: (1e-5, 1e-5)}


def projected(scene, threshold):
    tensors = list(scene.tensors[:4]) + scene.tensors[5:]
    return project(
        *tensors,
        width=scene.width,
        height=scene.height,
        near=0.01,
        low_pass=0.3,
        alpha_threshold=threshold,
        antialiased=False,
    )


@pytest.fixture
def fibers(monkeypatch):
    """Switches block kernels on the CPU on; off again, because ordinary kernels must not run in blocks."""
    monkeypatch.setattr(blending, "blend_on_cpu", blend_on_cuda)

    def run(task):
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
        try:
            return task()
        finally:
            monkeypatch.setattr(wp.config, "enable_cpu_blocks", False)

    return run


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("channels, deterministic", [(1, False), (3, False), (3, True), (9, False)])
def test_block_kernels_match_the_reference(fibers, dtype, channels, deterministic):
    # Enough overlap that queues spill over 32 and pixels finish early; a cut tile at the right and the bottom.
    scene = random_scene(count=600, channels=channels, width=44, height=26, spread=1.6, seed=2)
    threshold = 1.0 / 255.0
    with torch.no_grad():
        geometry = projected(scene.to(dtype), threshold)
        true_geometry = projected(scene.to(torch.float64), threshold)
    inputs = [t.detach().requires_grad_() for t in (geometry[0], geometry[1], geometry[3])]
    features = scene.tensors[4].to(dtype, copy=True).requires_grad_()
    means2d, conics, depths, opacities, extents = (t.detach() for t in geometry)
    records = pack_records(means2d, conics, opacities, extents, threshold)
    lists = build_tile_lists(records, depths, extents, scene.width, scene.height)
    assert int((lists.ranges[:, 1] - lists.ranges[:, 0]).max()) > 64

    def forward():
        return blend(
            *inputs,
            features,
            lists=lists,
            records=records,
            extents=extents,
            width=scene.width,
            height=scene.height,
            alpha_threshold=threshold,
            deterministic=deterministic,
        )

    image, transmittance = fibers(forward)
    true_inputs = [t.detach().requires_grad_() for t in (true_geometry[0], true_geometry[1], true_geometry[3])]
    true_features = scene.tensors[4].clone().requires_grad_()
    true_image, true_transmittance = blend_reference(
        *true_inputs, true_features, true_geometry[2], true_geometry[4], scene.width, scene.height, threshold
    )
    assert (true_transmittance < 0.001).any()
    value_bound, gradient_bound = BOUNDS[dtype]
    assert relative_error(image, true_image) < value_bound
    assert relative_error(transmittance, true_transmittance) < value_bound
    assert relative_error(1 - transmittance, 1 - true_transmittance) < value_bound
    loss = (image * random_like(image, 1)).sum() + (transmittance * random_like(transmittance, 2)).sum()
    fibers(loss.backward)
    truth = (true_transmittance * random_like(true_transmittance, 2)).sum()
    (truth + (true_image * random_like(true_image, 1)).sum()).backward()
    for ours, truth in zip([*inputs, features], [*true_inputs, true_features]):
        assert relative_error(ours.grad, truth.grad) < gradient_bound


def test_a_single_pixels_gradient_may_have_any_strides(fibers):
    scene = random_scene(count=600, channels=1, width=1, height=1, spread=1.6, seed=2).to(torch.float32, "cpu")
    with torch.no_grad():
        means2d, conics, depths, opacities, extents = projected(scene, 1 / 255)
    records = pack_records(means2d, conics, opacities, extents, 1 / 255)
    options = {"lists": build_tile_lists(records, depths, extents, 1, 1), "records": records, "extents": extents}
    options |= {"width": 1, "height": 1, "alpha_threshold": 1 / 255}
    features = scene.tensors[4].requires_grad_()
    image = fibers(lambda: blend(means2d, conics, opacities, features, **options))[0]
    fibers(image.sum().backward)
    assert float(features.grad.sum()) > 0


def test_nothing_by_gaussian_is_kept_for_the_backward_pass(fibers, monkeypatch):
    monkeypatch.setenv("KINETO_LOG_LEVEL", "99")  # the profiler's own messages
    scene = random_scene(count=600, channels=3, width=44, height=26, seed=2).to(torch.float32, "cpu")
    with torch.no_grad():
        means2d, conics, depths, opacities, extents = projected(scene, 1 / 255)
    records = pack_records(means2d, conics, opacities, extents, 1 / 255)
    inputs = [tensor.requires_grad_() for tensor in (means2d, conics, opacities, scene.tensors[4])]
    options = {"lists": build_tile_lists(records, depths, extents, 44, 26), "records": records, "extents": extents}
    options |= {"width": 44, "height": 26, "alpha_threshold": 1 / 255}
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        image = fibers(lambda: blend(*inputs, **options))[0]
    kept = sum(event.nbytes() for event in recorded.profiler.kineto_results.events() if event.name() == "[memory]")
    by_pixel = 3 + 1 + 1  # image, transmittance and the last Gaussian drawn
    assert image.requires_grad and kept == 4 * by_pixel * 44 * 26
    given = [weakref.ref(record) for record in records]
    del records, options["records"]
    assert [record() for record in given] == [None, None]
