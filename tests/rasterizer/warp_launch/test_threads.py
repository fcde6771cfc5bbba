"""A launch's ranges on the threads of a CPU: each is done once, whoever asks, with OpenMP and without."""

import threading
from itertools import pairwise

import pytest
import torch
import warp as wp

from sehdr_warp.rasterizer.warp_launch import threads
from sehdr_warp.rasterizer.warp_launch.launching import launch


@wp.kernel(enable_backward=True)
def add_squares(range_start: int, values: wp.array[float], sums: wp.array[float]):
    i = range_start + wp.tid()
    sums[i] += values[i] * values[i]


@pytest.fixture(autouse=True)
def three_threads(monkeypatch):
    monkeypatch.setenv("SEHDR_THREADS", "3")


@pytest.fixture(params=["OpenMP", "helpers"])
def means(request, monkeypatch):
    """Select the source of threads: torch's OpenMP, where it has one, or helpers of our own."""
    if request.param == "helpers":
        monkeypatch.setattr(threads, "openmp_parallel", lambda: 0)
    elif not threads.openmp_parallel():
        pytest.skip("torch has no OpenMP here")


def squares(count: int, ranges: torch.Tensor | None = None) -> bool:
    """Return whether each of `count` values is squared once."""
    values, sums = torch.arange(count).float(), torch.zeros(count)
    launch(add_squares, count, values, sums, ranges=ranges, min_range=1)
    return torch.equal(sums, values * values)


@pytest.mark.parametrize("count", [1, 2, 5, 1000])
def test_every_item_is_done_once(means, count):
    assert all(squares(count) for _ in range(50))


def test_more_ranges_than_threads_and_empty_ones(means):
    assert squares(100, torch.tensor([0, 0, 1, 1, 1, 7, 50, 50, 99, 100, 100], dtype=torch.int32))


def test_adjoints_are_shared_too(means):
    values, sums = torch.arange(3000).float(), torch.zeros(3000)
    by_values = torch.zeros(3000)
    gradients = [by_values, torch.ones(3000)]
    launch(add_squares, 3000, values, sums, gradients=gradients, min_range=1)
    assert torch.equal(by_values, 2 * values)


def test_more_threads_than_processors(means, monkeypatch):
    monkeypatch.setenv("SEHDR_THREADS", "16")
    assert all(squares(10_000) for _ in range(50))


def test_several_threads_may_share_at_once(means):
    right = []
    callers = [threading.Thread(target=lambda: right.append([squares(500) for _ in range(50)])) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(60)
    assert right == [[True] * 50] * 4


def test_a_kernel_of_too_many_parameters_is_refused(monkeypatch):
    monkeypatch.setattr(threads.shared_ranges, "LARGEST", 64)
    with pytest.raises(ValueError, match="bytes of parameters; ranges are shared with 64"):
        squares(10)


@pytest.mark.parametrize("count", [0, 1, 1023, 1024, 2049, 20_000, 100_000])
def test_ranges_cover_every_item_once(count):
    ranges = threads.even_ranges(count).tolist()
    assert ranges[0] == 0
    assert ranges[-1] == count
    assert ranges == sorted(ranges)
    assert len(ranges) <= 2 or min(b - a for a, b in pairwise(ranges)) >= 1024


def test_many_items_make_ranges_for_all_threads():
    assert len(threads.even_ranges(1 << 20)) - 1 == 3 * threads.RANGES_PER_THREAD
    assert len(threads.single_range(1 << 20)) == 2
