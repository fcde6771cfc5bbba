"""Backward passes of renders that CUDA graphs made."""

import pytest
import torch

from sehdr_warp.rasterizer import rasterize
from sehdr_warp.rasterizer.cuda_graphs import cache, captured_backward

from ..repeated_calls import CALLS, assert_alike, launched, recordings, scene_of
from ..scenes import random_like

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
    scene = scene_of()
    replayed, truth = [rasterize(*scene.arguments) for _ in range(CALLS)][-1], launched(*scene.arguments)
    assert recordings()
    parts = [
        (lambda drawing: (drawing.image * random_like(drawing.image, 1)).sum(), scene.tensors[:5]),
        (lambda drawing: (drawing.image * random_like(drawing.image, 2)).sum(), scene.tensors[4:5]),
        (lambda drawing: drawing.depths.sum(), scene.tensors[:1]),
        (lambda drawing: drawing.image.square().sum() + drawing.depths.sum(), scene.tensors[:4]),
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
