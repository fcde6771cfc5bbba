"""The recorded rasterizer is the rasterizer."""

import pytest
import torch

from sehdr_warp.splatting import RecordedRasterizer, rasterize

from .scenes import random_like, random_scene, relative_error

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")


def values_and_gradients(splat, scene, *, use_alpha=True):
    for tensor in scene.tensors:
        tensor.grad = None
    rendering = splat(*scene.arguments)
    loss = (rendering.image * random_like(rendering.image, 1)).sum()
    if use_alpha:
        loss = loss + (rendering.alpha * random_like(rendering.alpha, 2)).sum()
    loss.backward()
    made = [rendering.image, rendering.alpha, rendering.depths, rendering.radii]
    return [tensor.detach().clone() for tensor in (*made, *(t.grad for t in scene.tensors if t.grad is not None))]


def test_a_device_without_cuda_graphs_is_refused():
    with pytest.raises(ValueError, match="device cpu has no CUDA graphs"):
        RecordedRasterizer("cpu")


@needs_gpu
def test_replays_follow_their_arguments_shapes_and_need_of_room():
    splat = RecordedRasterizer("cuda:0")
    for count, channels in ((400, 3), (400, 3), (150, 9), (0, 3)):
        scene = random_scene(count=count, channels=channels).to(torch.float32, "cuda:0")
        for growth in (0.0, 0.4, 1.5):
            with torch.no_grad():
                scene.tensors[1] += growth
            ours = values_and_gradients(splat, scene)
            for mine, truth in zip(ours, values_and_gradients(rasterize, scene), strict=True):
                assert relative_error(mine, truth) < 1e-5


@needs_gpu
def test_gradients_add_up_over_calls_and_without_alpha():
    splat = RecordedRasterizer("cuda:0")
    scene = random_scene(count=300).to(torch.float32, "cuda:0")
    single = values_and_gradients(splat, scene, use_alpha=False)
    once = [tensor.grad.clone() for tensor in scene.tensors[:5]]
    for mine, truth in zip(single, values_and_gradients(rasterize, scene, use_alpha=False), strict=True):
        assert relative_error(mine, truth) < 1e-5
    for tensor in scene.tensors:
        tensor.grad = None
    for _ in range(3):
        rendering = splat(*scene.arguments)
        (rendering.image * random_like(rendering.image, 1)).sum().backward()
    for tensor, gradient in zip(scene.tensors, once):
        assert relative_error(tensor.grad, 3 * gradient) < 1e-5


@needs_gpu
def test_gradients_of_a_reshaped_parameter_add_up():
    scene = random_scene(count=300).to(torch.float32, "cuda:0")
    column = scene.tensors[3].detach()[:, None].requires_grad_()

    def summed(splat):
        column.grad = None
        for seed in (1, 2):
            image = splat(*scene.tensors[:3], column.squeeze(1), *scene.arguments[4:]).image
            (image * random_like(image, seed)).sum().backward()
        return column.grad.clone()

    assert relative_error(summed(RecordedRasterizer("cuda:0")), summed(rasterize)) < 1e-5


@needs_gpu
def test_a_backward_pass_that_comes_too_late_is_refused():
    splat = RecordedRasterizer("cuda:0")
    scene = random_scene(count=100).to(torch.float32, "cuda:0")
    early = splat(*scene.arguments).image.sum()
    splat(*scene.arguments)
    with pytest.raises(RuntimeError, match="called again before the backward pass"):
        early.backward()


@needs_gpu
def test_without_gradients_only_the_forward_pass_is_recorded():
    splat = RecordedRasterizer("cuda:0")
    scene = random_scene(count=100).to(torch.float32, "cuda:0")
    with torch.no_grad():
        rendering = splat(*scene.arguments)
        assert not rendering.image.requires_grad
        assert relative_error(rendering.image, rasterize(*scene.arguments).image) < 1e-6
