"""Calls of rasterize() that are replayed: what they return is what launched calls do, and stays."""

import ctypes
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sehdr_warp.compat.gsplat import rasterization
from sehdr_warp.kernels.constants import EPS2D
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.rasterizer import block_blending, captured_backward, captured_render, graph_cache, rasterize, tile_lists
from sehdr_warp.rasterizer.memory import OutOfMemory
from sehdr_warp.rasterizer.render_options import RenderOptions
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera

from .emulated_graphs import emulate
from .scenes import random_like, random_scene, relative_error

DEVICE = "cuda:0" if torch.cuda.is_available() else "cpu"
CALLS = graph_cache.WARMUP_CALLS + 3


@pytest.fixture(autouse=True)
def nothing_is_recorded(monkeypatch):
    graph_cache.clear_graphs()
    if DEVICE == "cpu":
        emulate(monkeypatch)
    yield
    graph_cache.clear_graphs()


def launched(*arguments, **options):
    """rasterize() with room for all pairs, which is never replayed."""
    return rasterize(*arguments, max_intersections=100_000, **options)


def scene_of(count=80, channels=3):
    return random_scene(count=count, channels=channels).to(torch.float32, DEVICE)


def recordings():
    return sum(size.captured for size in graph_cache._pools.values())


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


def assert_alike(ours, truth):
    for mine, true in zip(ours, truth, strict=True):
        assert relative_error(mine, true) < 5e-5  # Without a GPU, two ways of blending.


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("options", [{}, {"by_alpha": False}, {"depth": True, "antialiased": True}])
def test_replays_follow_their_arguments_and_their_need_of_room(options, many, monkeypatch):
    if many:  # As with more Gaussians than one sort takes.
        for module in (tile_lists, block_blending, captured_render, graph_cache):
            monkeypatch.setattr(module, "MAX_SINGLE_SORT", 0)
        monkeypatch.setattr(captured_render, "MAX_COPIED_GAUSSIANS", 0)
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


def test_pictures_stay_and_backward_passes_come_in_any_order():
    scene = scene_of()
    shifts = [0.02 * call for call in range(CALLS + graph_cache.MAX_GRAPHS)]

    def render_shifted(splat, shift):
        return splat(scene.tensors[0] + shift, *scene.arguments[1:]).image

    images = [render_shifted(rasterize, shift) for shift in shifts]
    truths = [render_shifted(launched, shift) for shift in shifts]
    assert recordings() == graph_cache.MAX_GRAPHS
    for place in (*range(1, len(shifts), 2), *range(0, len(shifts), 2)):
        pair = [
            torch.autograd.grad((i * random_like(i, place)).sum(), scene.tensors[:5])
            for i in (images[place], truths[place])
        ]
        assert_alike(*pair)
    assert_alike(images, truths)


@pytest.mark.parametrize("one_sort", [1 << 18, 0])
def test_a_retained_graph_has_the_gradients_of_each_part_in_any_order(one_sort, monkeypatch):
    monkeypatch.setattr(graph_cache, "MAX_SINGLE_SORT", one_sort)
    scene = scene_of()
    replayed, truth = [rasterize(*scene.arguments) for _ in range(CALLS)][-1], launched(*scene.arguments)
    assert recordings()
    parts = [
        (lambda drawing: (drawing.image * random_like(drawing.image, 1)).sum(), scene.tensors[:5]),
        (lambda drawing: (drawing.image * random_like(drawing.image, 2)).sum(), scene.tensors[4:5]),
        (lambda drawing: drawing.depths.sum(), scene.tensors[:1]),
        (lambda drawing: drawing.image.square().sum() + drawing.depths.sum(), scene.tensors[:4]),
    ]
    for loss, leaves in (*parts, *reversed(parts)):
        pair = [torch.autograd.grad(loss(drawing), leaves, retain_graph=True) for drawing in (replayed, truth)]
        assert_alike(*pair)
    of_means2d = [
        torch.autograd.grad(drawing.image.sum(), drawing.means2d, retain_graph=True) for drawing in (replayed, truth)
    ]
    assert_alike(*of_means2d)
    assert_alike(
        *[torch.autograd.grad(drawing.depths.square().sum(), scene.tensors[:1]) for drawing in (replayed, truth)]
    )


def test_gradients_of_leaves_are_contiguous_and_not_copied(monkeypatch):
    scene, addresses = scene_of(), []
    allocate = captured_backward.CapturedBackward.allocate

    def remember(*arguments, **options):
        memory = allocate(*arguments, **options)
        addresses.append(memory.zeros.data_ptr())
        return memory

    monkeypatch.setattr(captured_backward.CapturedBackward, "allocate", remember)
    for _ in range(CALLS):
        for tensor in scene.tensors:
            tensor.grad = None
        rasterize(*scene.arguments).image.sum().backward()
    gradients = [tensor.grad for tensor in scene.tensors[:5]]
    assert all(gradient.is_contiguous() for gradient in gradients)
    assert {gradient.untyped_storage().data_ptr() for gradient in gradients} == {addresses[-1]}


def test_calls_that_require_other_gradients_have_graphs_of_their_own():
    scene = scene_of()
    for required in ((0, 5), (4,), tuple(range(7))):
        for place, tensor in enumerate(scene.tensors):
            tensor.requires_grad_(place in required)
        images = [[rasterize(*scene.arguments) for _ in range(CALLS)][-1].image, launched(*scene.arguments).image]
        leaves, cotangent = [scene.tensors[place] for place in required], random_like(images[0], 1)
        assert_alike(*[torch.autograd.grad(image, leaves, cotangent) for image in images])
    assert len(graph_cache._pools) == 3 and all(pool.captured for pool in graph_cache._pools.values())


@pytest.mark.parametrize("place", [0, 1, 4])
def test_a_change_in_place_before_the_backward_pass_of_a_replay_is_refused(place):
    scene = scene_of()
    image = [rasterize(*scene.arguments).image for _ in range(CALLS)][-1]
    assert recordings()
    with torch.no_grad():
        scene.tensors[place] *= 1.5
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


@pytest.mark.parametrize("one_sort", [1 << 18, 0])
@pytest.mark.parametrize("most_copied", [1 << 18, 0])
@pytest.mark.parametrize("channels", [3, 4])
def test_without_gradients_pictures_stay_too(one_sort, most_copied, channels, monkeypatch):
    monkeypatch.setattr(tile_lists, "MAX_SINGLE_SORT", one_sort)
    monkeypatch.setattr(captured_render, "MAX_COPIED_GAUSSIANS", most_copied)
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
            rendering = rasterize(*moved, *tensors[5:], width, height, **options)
        assert all(bool(other.isnan().all()) for other in others)
        assert_alike([rendering.image.detach()], [launched(*moved, *tensors[5:], width, height, **options).image])
        images = rendering.image, rendering.transmittance
        others = [torch.full_like(like, torch.nan) for like in (*tensors, *images) for _ in range(4)]
        del moved, rendering, images
    assert recordings()


def test_of_many_gaussians_one_render_is_held(monkeypatch):
    monkeypatch.setattr(graph_cache, "MAX_SINGLE_SORT", 0)
    scene = scene_of()
    images = [rasterize(*scene.arguments).image for _ in range(CALLS)]
    assert recordings() == 1
    cotangent, truth = random_like(images[0], 1), launched(*scene.arguments).image
    expected = torch.autograd.grad(truth, scene.tensors[:5], cotangent)
    for image in images[-3:]:
        assert_alike(torch.autograd.grad(image, scene.tensors[:5], cotangent), expected)


def test_gradients_add_up_over_calls_and_cameras():
    scene = scene_of()
    poses, lenses = torch.stack([scene.tensors[5]] * 2), torch.stack([scene.tensors[6]] * 2)

    def summed(splat):
        for tensor in scene.tensors:
            tensor.grad = None
        for _ in range(CALLS):
            image = splat(*scene.tensors[:5], poses, lenses, scene.width, scene.height).image
            (image * random_like(image, 1)).sum().backward()
        return [tensor.grad.clone() for tensor in scene.tensors[:5]]

    assert_alike(summed(rasterize), summed(launched))


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
    monkeypatch.setattr(graph_cache, "CapturedRender", lambda tensors, options, pairs, differentiable: next(labels))
    pool = graph_cache.GraphPool()

    def take():
        return pool.begin_render((), RenderOptions(8, 8))

    assert not any(take() for _ in range(graph_cache.WARMUP_CALLS))
    in_use = [take() for _ in range(graph_cache.MAX_GRAPHS)]
    assert take() is None, "all are held"
    del in_use[1]
    assert take()._graph == "b"
    pool.grow(70)
    pool.grow(50)
    del in_use
    assert pool.idle == [], "too small, they are let go"
    monkeypatch.setattr(graph_cache, "CapturedRender", lambda tensors, options, pairs, differentiable: pairs)
    assert take()._graph == 70


def test_what_cannot_be_recorded_is_launched(monkeypatch):
    pool, requests = graph_cache.GraphPool(), []

    def record(tensors, options, intersections, differentiable):
        requests.append(intersections)
        raise torch.OutOfMemoryError("no memory")

    monkeypatch.setattr(graph_cache, "CapturedRender", record)
    calls = graph_cache.WARMUP_CALLS + 5
    assert not any(pool.begin_render((), RenderOptions(8, 8)) for _ in range(calls)) and len(requests) == 1


def test_packed_calls_of_gsplats_push_out_no_graphs():
    scene = scene_of()
    means, log_scales, quaternions, opacities, features, pose, (fx, fy, cx, cy) = scene.tensors
    lens = torch.stack([fx, 0 * fx, cx, 0 * fx, fy, cy, 0 * fx, 0 * fx, 0 * fx + 1]).view(1, 3, 3)
    for packed in (True, False):
        for _ in range(CALLS):
            splats = means, quaternions, log_scales.exp(), opacities, features
            rasterization(*splats, pose[None], lens, scene.width, scene.height, packed=packed)
        assert bool(graph_cache._pools) != packed


def test_renders_of_a_field_hold_no_graphs():
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 2.0])
    field = RadianceField(Gaussians.from_points(points, points, 0), response_by_name("srgb"), base_time=1.0).to(DEVICE)
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, np.eye(4))
    for _ in range(CALLS):
        field.render(camera)
        field.render_ldr(camera)
        field.render_mean(camera, torch.ones(40, device=DEVICE))
        field.weighted_sums(field.camera_tensors(camera), torch.ones(24, 32, 2, device=DEVICE))
    assert not graph_cache._pools
    for _ in range(CALLS):
        field.render_train_view(field.camera_tensors(camera), 1.0)
    assert recordings()


def test_only_the_latest_kinds_are_remembered():
    scene, kinds = scene_of(count=5), []
    tensors = scene.tensors

    def graphs(width):
        return graph_cache.get_or_create_pool(tensors, RenderOptions(width, 8))

    assert graph_cache.find_pool(tensors, RenderOptions(1, 8)) is None
    kinds = [graphs(1 + n) for n in range(graph_cache.MAX_POOLS)]
    assert graphs(1) is kinds[0] and graph_cache.find_pool(tensors, RenderOptions(1, 8)) is kinds[0]
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
    assert len(graph_cache._pools) == 3 and all(pool.captured for pool in graph_cache._pools.values())


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
    [pool] = graph_cache._pools.values()
    assert pool.captured


def test_options_that_equal_those_of_known_calls_are_checked_as_well():
    scene = scene_of(count=5)
    *tensors, width, height = scene.arguments
    for _ in range(CALLS):
        rasterize(*scene.arguments)
    for wrong in ((float(width), height), (width, float(height))):
        with pytest.raises(TypeError, match="expected a whole number"):
            rasterize(*tensors, *wrong)
    for eps2d in (torch.tensor(EPS2D, dtype=torch.float64), np.array([EPS2D])):
        with pytest.raises(TypeError, match="expected a number"):
            rasterize(*tensors, width, height, eps2d=eps2d)
    assert rasterize(*tensors, np.int64(width), height, depth=np.bool_(0)).image.shape[:2] == (height, width)


def test_a_count_is_waited_for_while_other_threads_run_and_missed_if_the_gpu_is_idle():
    graph = object.__new__(captured_render.CapturedRender)
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
        (graph,) = next(iter(graph_cache._pools.values())).idle
        replay, count_intersections = graph._runner.replay, graph.count_intersections
        monkeypatch.setattr(graph._runner, "replay", lambda: order.append("replay") or replay())
        with monkeypatch.context() as patch, pytest.raises(OutOfMemory):
            patch.setattr(graph, "count_intersections", end_before_the_count)
            rasterize(*scene.arguments)
        assert torch.equal(rasterize(*scene.arguments).image, image)
    assert order == ["replay", "wait", "replay"]
