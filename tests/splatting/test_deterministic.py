"""The same input, the same bits."""

import torch

from sehdr_warp.splatting import rasterize

from .scenes import random_like, random_scene, relative_error


def gradients(scene, deterministic, capacity=None):
    for tensor in scene.tensors:
        tensor.grad = None
    rendering = rasterize(*scene.arguments, deterministic=deterministic, capacity=capacity)
    ((rendering.image * random_like(rendering.image, 1)).sum() + rendering.alpha.sum()).backward()
    return [rendering.image, *(tensor.grad for tensor in scene.tensors[:5])]


def test_deterministic_gradients_repeat_bit_for_bit_and_are_the_others(device):
    scene = random_scene(count=3000, channels=5, width=120, height=70, spread=2.0, seed=3).to(torch.float32, device)
    first = gradients(scene, True)
    for _ in range(3):
        again = gradients(scene, True)
        assert all(torch.equal(a, b) for a, b in zip(first, again))
    for ours, other in zip(first, gradients(scene, False)):
        assert relative_error(ours, other) < 1e-5


def test_deterministic_gradients_with_room_to_spare(device):
    scene = random_scene(count=200, channels=3, seed=4).to(torch.float32, device)
    exact = gradients(scene, True)
    roomy = gradients(scene, True, capacity=50_000)
    assert all(torch.equal(a, b) for a, b in zip(exact, roomy))
