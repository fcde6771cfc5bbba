"""Torch operations and Warp launches in one CUDA graph."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.rasterizer import CudaGraphRunner, rasterize
from sehdr_warp.rasterizer.cuda_graphs import runner as cuda_graphs

from ..scenes import random_scene, relative_error

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")


def test_a_device_without_cuda_graphs_is_refused():
    with pytest.raises(ValueError, match="device cpu has no CUDA graphs"):
        CudaGraphRunner("cpu")


def test_no_two_recorders_alive_record_on_one_stream(monkeypatch):
    class Owner:
        pass

    places = iter(range(3))
    monkeypatch.setattr(cuda_graphs, "idle_streams", {})
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: (device, next(places)))
    device = torch.device("cuda:0")
    first, second, third = Owner(), Owner(), Owner()
    streams = [cuda_graphs.own_stream(owner, device) for owner in (first, second)]
    assert streams[0] != streams[1]
    del first
    assert cuda_graphs.own_stream(third, device) == streams[0]
    assert cuda_graphs.own_stream(Owner(), device) == (device, 2), "taken anew, as both others are in use"


def test_work_on_a_capture_stream_is_launched(monkeypatch):
    stream = SimpleNamespace(wait_stream=lambda other: None)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)
    monkeypatch.setattr(torch.cuda, "stream", nullcontext)
    runner = object.__new__(CudaGraphRunner)
    runner.device, runner.stream = torch.device("cuda:0"), stream
    with runner.on_capture_stream():
        assert cuda_graphs.replays_are_off()
    assert not cuda_graphs.replays_are_off()


@needs_gpu
def test_a_recorded_render_and_its_gradients_follow_their_inputs():
    scene = random_scene(count=300).to(torch.float32, "cuda:0")
    target = torch.rand(scene.height, scene.width, 3, device="cuda:0")

    def step():
        rendering = rasterize(*scene.arguments, max_intersections=20_000)
        loss = (rendering.image - target).square().sum()
        gradients = torch.autograd.grad(loss, scene.tensors[:5])
        return loss.detach(), rendering.overflow, *gradients

    step()
    recorder = CudaGraphRunner("cuda:0")
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
    recorder = CudaGraphRunner("cuda:0")
    values = torch.ones(4, device="cuda:0", requires_grad=True)

    def step():
        values.grad = None
        loss = values.square().sum()
        loss.backward()
        return loss, values.grad

    with recorder.on_capture_stream():
        kept_loss, _ = step()
    assert recorder.run("step", lambda: step()[1]).tolist() == [2.0] * 4
    assert kept_loss.requires_grad


@needs_gpu
def test_garbage_with_a_recording_in_it_is_not_collected_during_another():
    class Holder:
        def __init__(self):
            self.me, self.recorder = self, CudaGraphRunner("cuda:0")
            self.values = self.recorder.run("a", lambda: torch.ones(1 << 20, device="cuda:0") * 2)

    def step():
        total = torch.zeros(1 << 20, device="cuda:0")
        for _ in range(3000):
            total = total + len([[] for _ in range(20)])  # enough new containers to wake the collector
        return total

    for _ in range(3):
        Holder()
        recorder = CudaGraphRunner("cuda:0")
        for _ in range(2):
            assert (recorder.run("step", step) == 60_000).all()


@needs_gpu
def test_an_invalidated_recording_is_made_again():
    recorder, factor = CudaGraphRunner("cuda:0"), [2.0]
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
    large = torch.zeros(2 * cuda_graphs.IDLE_BYTES, dtype=torch.uint8, device="cuda")
    held = torch.cuda.memory_reserved()
    del large
    assert torch.cuda.memory_reserved() == held
    CudaGraphRunner("cuda:0")
    assert torch.cuda.memory_reserved() <= held - 2 * cuda_graphs.IDLE_BYTES + (4 << 20)
