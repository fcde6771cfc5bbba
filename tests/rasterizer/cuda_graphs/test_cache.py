"""Calls of rasterize() that are replayed: what they return is what launched calls do, and stays."""

import ctypes
import threading
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sehdr_warp.compat.gsplat import rasterization
from sehdr_warp.kernels.constants import EPS2D
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.rasterizer import blending_cuda, rasterize, render_options, tile_lists
from sehdr_warp.rasterizer.cuda_graphs import cache, render_graph
from sehdr_warp.rasterizer.memory import OutOfMemory
from sehdr_warp.rasterizer.render_options import RenderOptions
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera

from ..repeated_calls import CALLS, DEVICE, assert_alike, launched, recordings, scene_of
from ..scenes import random_like

pytestmark = pytest.mark.usefixtures("no_graphs")


def values_and_gradients(splat, scene, *, by_alpha=True, **options):
    for tensor in scene.tensors:
        tensor.grad = None
    drawing = splat(*scene.arguments, **options)
    drawing.means2d.retain_grad()
    loss = (drawing.image * random_like(drawing.image, 1)).sum()
    if by_alpha:
        loss = loss + (drawing.alpha * random_like(drawing.alpha, 2)).sum()
    if drawing.depth is not None:
        loss = loss + (drawing.depth * random_like(drawing.depth, 3)).sum()
    loss.backward()
    gradients = [tensor.grad for tensor in (*scene.tensors, drawing.means2d) if tensor.grad is not None]
    return [
        tensor.detach().clone() for tensor in (drawing.image, drawing.alpha, drawing.depths, drawing.radii, *gradients)
    ]


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("options", [{}, {"by_alpha": False}, {"depth": True, "antialiased": True}])
def test_replays_follow_their_arguments_and_their_need_of_room(options, many, monkeypatch):
    if many:  # As with more Gaussians than one sort takes.
        for module in (tile_lists, blending_cuda, render_graph, cache):
            monkeypatch.setattr(module, "MAX_SINGLE_SORT", 0)
        monkeypatch.setattr(render_graph, "MAX_COPIED_GAUSSIANS", 0)
    for count, channels in ((80, 3), (40, 9), (80, 3)):
        scene = scene_of(count, channels)
        for growth in (0.0, 0.4, 1.5):
            with torch.no_grad():
                scene.tensors[1] += growth
            for _ in range(CALLS):
                ours = values_and_gradients(rasterize, scene, **options)
                with torch.no_grad():
                    scene.tensors[0] += 0.01
                    scene.tensors[4] *= 0.9
            with torch.no_grad():
                scene.tensors[0] -= 0.01
                scene.tensors[4] /= 0.9
            assert_alike(ours, values_and_gradients(launched, scene, **options))
    assert recordings()


@pytest.mark.parametrize("one_sort", [1 << 18, 0])
@pytest.mark.parametrize("most_copied", [1 << 18, 0])
@pytest.mark.parametrize("channels", [3, 4])
def test_without_gradients_pictures_stay_too(one_sort, most_copied, channels, monkeypatch):
    monkeypatch.setattr(tile_lists, "MAX_SINGLE_SORT", one_sort)
    monkeypatch.setattr(render_graph, "MAX_COPIED_GAUSSIANS", most_copied)
    scene = scene_of(channels=channels)
    with torch.no_grad():
        arguments = [[*scene.arguments[:4], scene.tensors[4] * k, *scene.arguments[5:]] for k in range(1, 9)]
        images = [rasterize(*each).image for each in arguments]
        truth = launched(*scene.arguments).image
    assert recordings() == 1 and not images[-1].requires_grad
    assert_alike([image / k for k, image in enumerate(images, 1)], [truth] * 8)


@pytest.mark.parametrize("differentiable", [False, True])
@pytest.mark.parametrize("options", [{}, {"depth": True}])
def test_renders_neither_use_nor_change_memory_that_was_freed(options, differentiable):
    scene, others = scene_of(), []
    *tensors, width, height = scene.arguments
    for call in range(4 * CALLS):
        with torch.set_grad_enabled(differentiable):
            moved = [tensor * (1.0 - 1e-3 * call) for tensor in tensors[:5]]
            arguments = [*moved, *tensors[5:], width, height]
            rendering = rasterize(*arguments, **options)
        assert all(bool(other.isnan().all()) for other in others)
        assert_alike([rendering.image.detach()], [launched(*arguments, **options).image])
        images = rendering.image, rendering.transmittance
        others = [torch.full_like(like, torch.nan) for like in (*tensors, *images) for _ in range(4)]
        del moved, rendering, images
    assert recordings()


def test_of_many_gaussians_one_render_is_held(monkeypatch):
    monkeypatch.setattr(cache, "MAX_SINGLE_SORT", 0)
    scene = scene_of()
    images = [rasterize(*scene.arguments).image for _ in range(CALLS)]
    assert recordings() == 1
    cotangent, truth = random_like(images[0], 1), launched(*scene.arguments).image
    expected = torch.autograd.grad(truth, scene.tensors[:5], cotangent)
    for image in images[-3:]:
        assert_alike(torch.autograd.grad(image, scene.tensors[:5], cotangent), expected)


def test_a_feature_that_is_not_finite_is_culled_in_a_replay_as_well():
    scene = scene_of()
    for value in (1.0, float("nan")):
        with torch.no_grad():
            scene.tensors[4][7] = value
        for _ in range(CALLS):
            drawing = rasterize(*scene.arguments)
    assert recordings() and not drawing.visible[7] and drawing.visible.any() and bool(drawing.image.isfinite().all())


def test_calls_are_recorded_after_some_and_hold_what_they_were_given(monkeypatch):
    labels = iter("abcdefgh")
    monkeypatch.setattr(cache, "RenderGraph", lambda tensors, options, pairs, differentiable: next(labels))
    pool = cache.GraphPool()

    def take():
        return pool.begin_render((), RenderOptions(8, 8))

    assert not any(take() for _ in range(cache.WARMUP_CALLS))
    in_use = [take() for _ in range(cache.MAX_GRAPHS)]
    assert take() is None, "all are held"
    del in_use[1]
    assert take()._graph == "b"
    pool.grow(70)
    pool.grow(50)
    del in_use
    assert pool.idle == [], "too small, they are let go"
    monkeypatch.setattr(cache, "RenderGraph", lambda tensors, options, pairs, differentiable: pairs)
    assert take()._graph == 70


def test_what_cannot_be_recorded_is_launched(monkeypatch):
    pool, requests = cache.GraphPool(), []

    def record(tensors, options, intersections, differentiable):
        requests.append(intersections)
        raise torch.OutOfMemoryError("no memory")

    monkeypatch.setattr(cache, "RenderGraph", record)
    calls = cache.WARMUP_CALLS + 5
    assert not any(pool.begin_render((), RenderOptions(8, 8)) for _ in range(calls)) and len(requests) == 1


def test_packed_calls_of_gsplats_push_out_no_graphs():
    scene = scene_of()
    means, log_scales, quaternions, opacities, features, pose, (fx, fy, cx, cy) = scene.tensors
    lens = torch.stack([fx, 0 * fx, cx, 0 * fx, fy, cy, 0 * fx, 0 * fx, 0 * fx + 1]).view(1, 3, 3)
    for packed in (True, False):
        for _ in range(CALLS):
            splats = means, quaternions, log_scales.exp(), opacities, features
            rasterization(*splats, pose[None], lens, scene.width, scene.height, packed=packed)
        assert bool(cache.pools) != packed


def test_renders_of_a_field_hold_no_graphs():
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 2.0])
    field = RadianceField(Gaussians.from_points(points, points, 0), response_by_name("srgb"), base_time=1.0).to(DEVICE)
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, np.eye(4))
    for _ in range(CALLS):
        field.render(camera)
        field.render_ldr(camera)
        field.render_mean(camera, torch.ones(40, device=DEVICE))
        field.weighted_sums(field.camera_tensors(camera), torch.ones(24, 32, 2, device=DEVICE))
    assert not cache.pools
    for _ in range(CALLS):
        field.render_photo(field.camera_tensors(camera), 1.0)
    assert recordings()


def test_only_the_latest_kinds_are_remembered():
    scene, kinds = scene_of(count=5), []
    tensors = scene.tensors

    def graphs(width):
        return cache.pool_for(tensors, RenderOptions(width, 8))

    assert cache.checked_pool(tensors, RenderOptions(1, 8)) is None
    kinds = [graphs(1 + n) for n in range(cache.MAX_POOLS)]
    assert graphs(1) is kinds[0] and cache.checked_pool(tensors, RenderOptions(1, 8)) is kinds[0]
    graphs(99)
    assert graphs(1) is kinds[0] and graphs(2) is not kinds[1]


def test_only_calls_whose_arguments_were_checked_are_known():
    scene = scene_of(count=5)
    for _ in range(CALLS):
        rasterize(*scene.arguments)
    for place, change in ((0, torch.Tensor.double), (4, lambda t: t[:-1]), (6, lambda t: t.tolist())):
        wrong = [change(t) if k == place else t for k, t in enumerate(scene.arguments)]
        with pytest.raises((ValueError, TypeError), match="means|features|intrinsics"):
            rasterize(*wrong)


def test_tensors_that_are_not_contiguous_are_read_by_their_strides():
    scene = scene_of()
    truth = launched(*scene.arguments).image
    cotangent = random_like(truth, 1)
    expected = torch.autograd.grad(truth, scene.tensors[:5], cotangent)
    for layout in (lambda t: t, lambda t: torch.stack([t, -t], -1)[..., 0], lambda t: t.t().contiguous().t()):
        for _ in range(CALLS):
            leaves = [layout(tensor.detach()).requires_grad_() for tensor in scene.tensors[:5]]
            arguments = [*leaves, *scene.arguments[5:]]
            image = rasterize(*arguments).image
        assert_alike([image], [truth])
        assert_alike(torch.autograd.grad(image, leaves, cotangent), expected)
    assert len(cache.pools) == 3 and all(pool.captured for pool in cache.pools.values())


def test_a_tensor_may_be_passed_twice():
    scene = scene_of()
    means, log_scales, quaternions, opacities, _, *others = scene.arguments
    arguments = means, log_scales, quaternions, opacities, means, *others
    truth = launched(*arguments).image
    cotangent = random_like(truth, 1)
    [expected] = torch.autograd.grad(truth, [means], cotangent)
    for _ in range(CALLS):
        image = rasterize(*arguments).image
    assert_alike([image], [truth])
    assert_alike(torch.autograd.grad(image, [means], cotangent), [expected])
    [pool] = cache.pools.values()
    assert pool.captured


def refuse_as_torch_does(*arguments):
    raise RuntimeError("Cannot call CUDAGeneratorState::replay_prologue during CUDA graph capture")


def test_a_call_that_is_known_is_refused_within_a_capture(monkeypatch):
    scene = scene_of()
    with torch.no_grad(), nullcontext() if DEVICE == "cpu" else torch.cuda.stream(stream := torch.cuda.Stream()):
        image = [rasterize(*scene.arguments).image for _ in range(CALLS)][-1]
        with pytest.raises(RuntimeError, match="give max_intersections"):
            if DEVICE == "cpu":
                with monkeypatch.context() as patch:
                    patch.setattr(render_graph.RenderGraph, "replay", refuse_as_torch_does)
                    patch.setattr(render_options, "is_capturing", lambda device: True)
                    rasterize(*scene.arguments)
            with torch.cuda.graph(torch.cuda.CUDAGraph(), stream=stream):
                rasterize(*scene.arguments)
        assert_alike([rasterize(*scene.arguments).image], [image])


def test_options_that_equal_those_of_known_calls_are_checked_as_well():
    scene = scene_of(count=5)
    *tensors, width, height = scene.arguments
    for _ in range(CALLS):
        rasterize(*scene.arguments)
    for wrong in ((float(width), height), (width, float(height))):
        arguments = [*tensors, *wrong]
        with pytest.raises(TypeError, match="expected a whole number"):
            rasterize(*arguments)
    for eps2d in (torch.tensor(EPS2D, dtype=torch.float64), np.array([EPS2D])):
        with pytest.raises(TypeError, match="expected a number"):
            rasterize(*tensors, width, height, eps2d=eps2d)
    assert rasterize(*tensors, np.int64(width), height, depth=np.bool_(0)).image.shape[:2] == (height, width)


def test_a_count_is_waited_for_while_other_threads_run_and_missed_if_the_gpu_is_idle():
    graph = object.__new__(render_graph.RenderGraph)
    graph._count, ended = ctypes.c_int64(-1), threading.Event()
    graph._stream = SimpleNamespace(query=ended.is_set)

    def count():
        time.sleep(0.01)
        graph._count.value = 7
        ended.set()

    thread = threading.Thread(target=count)
    thread.start()
    assert graph.count_intersections() == 7
    thread.join()
    graph._count.value = -1
    with pytest.raises(RuntimeError, match="has not counted"):
        graph.count_intersections()


def test_a_graph_whose_count_was_not_read_is_waited_for(monkeypatch):
    scene, order = scene_of(), []

    def end_before_the_count():
        count_intersections()
        graph._count.value = -1  # As if the GPU had not counted yet.
        graph._stream = SimpleNamespace(synchronize=lambda: order.append("wait"), query=lambda: False)
        raise torch.OutOfMemoryError("no memory")

    with torch.no_grad():
        for _ in range(CALLS):
            image = rasterize(*scene.arguments).image
        (graph,) = next(iter(cache.pools.values())).idle
        replay, count_intersections = graph._runner.replay, graph.count_intersections
        monkeypatch.setattr(graph._runner, "replay", lambda: order.append("replay") or replay())
        with monkeypatch.context() as patch, pytest.raises(OutOfMemory):
            patch.setattr(graph, "count_intersections", end_before_the_count)
            rasterize(*scene.arguments)
        assert torch.equal(rasterize(*scene.arguments).image, image)
    assert order == ["replay", "wait", "replay"]
