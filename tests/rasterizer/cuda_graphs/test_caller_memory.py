"""Copies between a CUDA graph's memory and its callers', by addresses."""

import weakref

import pytest
import torch

from sehdr_warp.rasterizer.cuda_graphs.caller_memory import CallerMemory

from ..emulated_graphs import emulate

DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")


@pytest.fixture(autouse=True)
def without_a_gpu(monkeypatch):
    if DEVICE.type == "cpu":
        emulate(monkeypatch)


def numbers(*shape):
    return torch.rand(shape, device=DEVICE)


def test_inputs_are_read_and_outputs_written_where_the_caller_has_them():
    callers, fixed = CallerMemory(DEVICE), [numbers(700, 3), numbers(1024), numbers(4, 4)]
    for _ in range(2):
        inputs, outputs = [torch.rand_like(tensor) for tensor in fixed], [numbers(1024), numbers(4, 4)]
        zeros = numbers(1500)
        callers.set(inputs, outputs, zeros)
        callers.read(fixed)
        assert all(map(torch.equal, fixed, inputs))
        callers.write(fixed[1:], 1300)
        assert all(map(torch.equal, outputs, fixed[1:]))
        assert not zeros[:1300].any() and zeros[1300:].all()


def test_nothing_is_copied_before_a_caller_is_known_and_zeros_can_be_left_out():
    callers, fixed = CallerMemory(DEVICE), [numbers(3)]
    before = fixed[0].clone()
    callers.read(fixed)
    callers.write(fixed, 100)
    assert torch.equal(fixed[0], before)
    output = torch.zeros_like(before)
    callers.set([before], [output], None)
    callers.read(fixed)
    callers.write(fixed, 100)
    assert torch.equal(output, before)


def test_more_numbers_than_one_launch_has_threads_are_refused():
    with pytest.raises(RuntimeError, match="too many for one launch"):
        CallerMemory(DEVICE).read([numbers(1).expand(1 << 30)])


def test_a_call_with_fewer_tensors_than_the_last_one_has_its_zeros():
    for count in (5, 2, 3):
        callers, fixed = CallerMemory(DEVICE), [numbers(7) for _ in range(count)]
        outputs, zeros = [numbers(7) for _ in fixed], numbers(6)
        callers.set([], outputs, zeros)
        callers.read([])
        callers.write(fixed, 6)
        assert all(map(torch.equal, outputs, fixed)) and not zeros.any()


def test_what_the_graph_reads_into_lives_as_long_as_its_addresses():
    callers, fixed = CallerMemory(DEVICE), numbers(5)
    alive = weakref.ref(fixed)
    callers.read([fixed])
    del fixed
    assert alive() is not None
