"""Backward passes of renders that CUDA graphs made."""

import weakref

import pytest
import torch

from sehdr_warp.rasterizer import rasterize
from sehdr_warp.rasterizer.cuda_graphs import cache, captured_backward, render_graph
from sehdr_warp.rasterizer.reference import rasterize_reference

from ..repeated_calls import CALLS, DEVICE, assert_alike, launched, recordings, scene_of
from ..scenes import random_like, random_scene, relative_error

pytestmark = pytest.mark.usefixtures("no_graphs")


def test_pictures_stay_and_backward_passes_come_in_any_order():
    scene = scene_of()
    shifts = [0.02 * call for call in range(CALLS + cache.MAX_GRAPHS)]

    def render_shifted(splat, shift):
        return splat(scene.tensors[0] + shift, *scene.arguments[1:]).image

    images = [render_shifted(rasterize, shift) for shift in shifts]
    truths = [render_shifted(launched, shift) for shift in shifts]
    assert recordings() == cache.MAX_GRAPHS
    for place in (*range(1, len(shifts), 2), *range(0, len(shifts), 2)):
        pair = [
            torch.autograd.grad((i * random_like(i, place)).sum(), scene.tensors[:5])
            for i in (images[place], truths[place])
        ]
        assert_alike(*pair)
    assert_alike(images, truths)


@pytest.mark.parametrize("one_sort", [1 << 18, 0])
def test_a_retained_graph_has_the_gradients_of_each_part_in_any_order(one_sort, monkeypatch):
    monkeypatch.setattr(cache, "MAX_SINGLE_SORT", one_sort)
    scene, replayed = scene_of(), None
    for _ in range(CALLS):
        del replayed  # Its graph is the next one's: of many Gaussians there is only one.
        replayed = rasterize(*scene.arguments)
    truth = launched(*scene.arguments)
    assert recordings() == 1 and not any(pool.idle for pool in cache.pools.values())
    parts = [
        (lambda drawing: (drawing.image * random_like(drawing.image, 1)).sum(), scene.tensors[:5]),
        (lambda drawing: (drawing.image * random_like(drawing.image, 2)).sum(), scene.tensors[4:5]),
        (lambda drawing: drawing.depths.sum(), scene.tensors[::5]),
        (lambda drawing: drawing.image.square().sum() + drawing.depths.sum(), scene.tensors[:4]),
        (lambda drawing: drawing.image.sum() + drawing.means2d.square().sum(), scene.tensors[5:]),
    ]
    for loss, leaves in parts + parts[::-1]:
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
    assert len(cache.pools) == 3 and all(pool.captured for pool in cache.pools.values())


@pytest.mark.parametrize("place", [0, 1, 4])
def test_a_change_in_place_before_the_backward_pass_of_a_replay_is_refused(place):
    scene = scene_of()
    image = [rasterize(*scene.arguments).image for _ in range(CALLS)][-1]
    assert recordings()
    with torch.no_grad():
        scene.tensors[place] *= 1.5
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


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


@pytest.mark.parametrize("change", ["in place", "by another", "of leaves", "by depths", "none"])
def test_gradients_that_are_not_of_the_image_alone_reach_the_gaussians(change):
    scene = scene_of()

    def scale(gradient):
        gradient.mul_(3)

    def gradients(splat):
        for tensor in scene.tensors:
            tensor.grad = None
        drawing = splat(*scene.arguments)
        loss = (drawing.image * random_like(drawing.image, 1)).sum()
        hooks = []
        if change == "in place":
            hooks.append(drawing.means2d.register_hook(scale))
        if change == "by another":
            hooks.append(drawing.means2d.register_hook(lambda gradient: 3 * gradient))
        if change == "of leaves":
            hooks.append(scene.tensors[4].register_post_accumulate_grad_hook(lambda leaf: scale(leaf.grad)))
        if change == "by depths":
            loss = loss + drawing.depths.square().sum()
        loss.backward()
        for hook in hooks:
            hook.remove()
        return [tensor.grad.clone() for tensor in scene.tensors]

    replayed = [gradients(rasterize) for _ in range(CALLS)]
    assert recordings()
    assert_alike(replayed[-1], gradients(launched))


@pytest.mark.parametrize("required", [(5, 6), (5,), (6,), (0, 5), (0,)])
@pytest.mark.parametrize("count, few", [(80, 1 << 18), (80, 0), (1, 1 << 18)])
def test_gradients_of_the_camera_are_the_references_each_time(count, few, required, monkeypatch):
    monkeypatch.setattr(render_graph, "MAX_COPIED_GAUSSIANS", few)
    scene = random_scene(count, seed=5).to(torch.float32, DEVICE)
    rows, new_zeros = [], torch.Tensor.new_zeros
    kernels, projection_kernel = set(), captured_backward.projection_kernel

    def watch(tensor, *shape, **options):
        zeros = new_zeros(tensor, *shape, **options)
        if zeros.shape in ((count, 4, 4), (count, 4)):
            rows.append(weakref.ref(zeros))
        return zeros

    def watch_kernel(*kind):
        kernels.add(kind[-1])
        return projection_kernel(*kind)

    monkeypatch.setattr(captured_backward, "projection_kernel", watch_kernel)
    for place, tensor in enumerate(scene.tensors):
        tensor.requires_grad_(place in required)
    leaves = [scene.tensors[place] for place in required]
    truth = scene.to(torch.float64, "cpu")
    image = [rasterize(*scene.arguments).image for _ in range(CALLS)][-1]
    assert recordings()
    monkeypatch.setattr(torch.Tensor, "new_zeros", watch)  # Which the CPU's launched calls do not use.
    gradients = [torch.autograd.grad(image, leaves, random_like(image, 3), retain_graph=True) for _ in range(3)]
    true_image = rasterize_reference(*truth.arguments).image
    true = torch.autograd.grad(true_image, [truth.tensors[place] for place in required], random_like(true_image, 3))
    for each in gradients:
        for mine, right in zip(each, true, strict=True):
            assert mine.shape == right.shape and mine.is_contiguous() and right.any()
            assert relative_error(mine, right) < 1e-4
    assert len({tensor.data_ptr() for each in gradients for tensor in each}) == 3 * len(required)
    assert kernels == {bool({5, 6} & {*required})}
    assert len(rows) == 3 * len({5, 6} & {*required}) and not any(row() is not None for row in rows)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="the CPU is tested with any number of threads")
@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("way", ["launched", "replayed", "deterministic"])
def test_gradients_of_cameras_repeat_bit_for_bit_on_a_gpu(way, cameras):
    *gaussians, pose, intrinsics = random_scene(count=50_000, width=400, height=400, size=0.02).tensors
    if cameras > 1:
        pose, intrinsics = torch.stack([pose] * cameras), torch.stack([intrinsics] * cameras)
    tensors = [tensor.to("cuda:0", torch.float32).requires_grad_() for tensor in (*gaussians, pose, intrinsics)]
    options = {"launched": {"max_intersections": 10_000_000}, "deterministic": {"deterministic": True}}.get(way, {})

    def gradients():
        drawing = rasterize(*tensors, 400, 400, **options)
        # Those of the image go through the blend's, whose last bits differ unless deterministic.
        result = drawing.image if way == "deterministic" else drawing.means2d
        return torch.autograd.grad(result, tensors[5:], random_like(result, 3))

    for _ in range(CALLS):
        gradients()
    assert bool(recordings()) == (way == "replayed")
    first = gradients()
    for _ in range(20):
        assert all(torch.equal(a, b) for a, b in zip(first, gradients(), strict=True))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="memory of a GPU")
@pytest.mark.parametrize("way", ["launched", "replayed"])
def test_memory_of_each_gaussians_own_camera_is_free_after_a_backward_pass(way):
    count = 300_000
    scene = random_scene(count=count, size=0.01).to(torch.float32, "cuda:0")
    draw = rasterize if way == "replayed" else launched
    for place, tensor in enumerate(scene.tensors):
        tensor.requires_grad_(place > 4)
    for _ in range(CALLS):
        torch.autograd.grad(draw(*scene.arguments).image.sum(), scene.tensors[5:])
    assert bool(recordings()) == (way == "replayed")
    image = draw(*scene.arguments).image
    before = torch.cuda.memory_allocated()
    torch.autograd.grad(image.sum(), scene.tensors[5:], retain_graph=True)
    assert torch.cuda.memory_allocated() - before < 1 << 20
