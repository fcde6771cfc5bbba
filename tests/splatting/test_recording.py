"""Torch operations and Warp launches in one CUDA graph, and the recorded rasterizer, which is the rasterizer."""

import pytest
import torch

from sehdr_warp.splatting import GraphRecorder, RecordedRasterizer, rasterize, recording

from .scenes import random_like, random_scene, relative_error

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")


@pytest.mark.parametrize("recorder", [GraphRecorder, RecordedRasterizer])
def test_a_device_without_cuda_graphs_is_refused(recorder):
    with pytest.raises(ValueError, match="device cpu has no CUDA graphs"):
        recorder("cpu")


def test_no_two_recorders_alive_record_on_one_stream(monkeypatch):
    class Owner:
        pass

    taken = iter(range(3))
    monkeypatch.setattr(recording, "_idle_streams", {})
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: (device, next(taken)))
    device = torch.device("cuda:0")
    first, second, third = Owner(), Owner(), Owner()
    streams = [recording._own_stream(owner, device) for owner in (first, second)]
    assert streams[0] != streams[1]
    del first
    assert recording._own_stream(third, device) == streams[0]
    assert recording._own_stream(Owner(), device) == (device, 2), "taken anew, as both others are in use"


@needs_gpu
def test_a_recorded_render_and_its_gradients_follow_their_inputs():
    scene = random_scene(count=300).to(torch.float32, "cuda:0")
    target = torch.rand(scene.height, scene.width, 3, device="cuda:0")

    def step():
        rendering = rasterize(*scene.arguments, capacity=20_000)
        loss = (rendering.image - target).square().sum()
        gradients = torch.autograd.grad(loss, scene.tensors[:5])
        return loss.detach(), rendering.overflow, *gradients

    step()
    recorder = GraphRecorder("cuda:0")
    for shift in (0.0, 0.3, -0.2):
        with torch.no_grad():
            scene.tensors[0] += shift
        replayed = [tensor.clone() for tensor in recorder.run("step", step)]
        launched = step()
        assert not replayed[1]
        for ours, truth in zip(replayed, launched):
            assert relative_error(ours, truth) < 1e-5


@needs_gpu
def test_a_launched_graph_that_lives_on_spoils_no_recording():
    recorder = GraphRecorder("cuda:0")
    values = torch.ones(4, device="cuda:0", requires_grad=True)

    def step():
        values.grad = None
        loss = values.square().sum()
        loss.backward()
        return loss, values.grad

    with recorder.launching():
        kept, _ = step()
    assert recorder.run("step", lambda: step()[1]).tolist() == [2.0] * 4
    assert kept.requires_grad


@needs_gpu
def test_garbage_with_a_recording_in_it_is_not_collected_during_another():
    class Holder:
        def __init__(self):
            self.me, self.recorder = self, GraphRecorder("cuda:0")
            self.values = self.recorder.run("a", lambda: torch.ones(1 << 20, device="cuda:0") * 2)

    def step():
        total = torch.zeros(1 << 20, device="cuda:0")
        for _ in range(3000):
            total = total + len([[] for _ in range(20)])  # enough new containers to wake the collector
        return total

    for _ in range(3):
        Holder()
        recorder = GraphRecorder("cuda:0")
        for _ in range(2):
            assert (recorder.run("step", step) == 60_000).all()


@needs_gpu
def test_an_invalidated_recording_is_made_again():
    recorder, factor = GraphRecorder("cuda:0"), [2.0]
    values = torch.ones(4, device="cuda:0")

    def step():
        return values * factor[0]

    assert recorder.run("a", step).tolist() == [2.0] * 4
    factor[0] = 3.0
    assert recorder.run("a", step).tolist() == [2.0] * 4
    recorder.invalidate()
    assert recorder.run("a", step).tolist() == [3.0] * 4
    assert recorder.run("b", step).tolist() == [3.0] * 4
    recorder.invalidate()
    assert recorder.run(None, step).tolist() == [3.0] * 4


@needs_gpu
def test_a_recording_leaves_the_device_what_launches_no_longer_use():
    large = torch.zeros(2 * recording.IDLE_BYTES, dtype=torch.uint8, device="cuda")
    held = torch.cuda.memory_reserved()
    del large
    assert torch.cuda.memory_reserved() == held
    GraphRecorder("cuda:0")
    assert torch.cuda.memory_reserved() <= held - 2 * recording.IDLE_BYTES + (4 << 20)


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
