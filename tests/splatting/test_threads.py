"""Work spread over threads: all of it is done once, whoever asks, and exceptions come back."""

import threading
import time

import pytest

from sehdr_warp.splatting import threads


@pytest.fixture(autouse=True)
def three_threads(monkeypatch):
    monkeypatch.setenv("SEHDR_THREADS", "3")


def finishes(task) -> bool:
    """Whether task() returns within seconds; a dead-lock must not hold up the tests."""
    thread = threading.Thread(target=task, daemon=True)
    thread.start()
    thread.join(20)
    return not thread.is_alive()


def test_a_task_may_spread_its_own_work():
    done = []

    def outer(i):
        threads.run_parallel(lambda j: done.append((i, j)), range(6))

    assert finishes(lambda: threads.run_parallel(outer, range(8)))
    assert sorted(done) == [(i, j) for i in range(8) for j in range(6)]


def test_several_threads_may_spread_work_at_once():
    done = []
    callers = [
        threading.Thread(target=lambda: threads.run_parallel(done.append, range(50)), daemon=True) for _ in range(4)
    ]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(20)
    assert sorted(done) == sorted(list(range(50)) * 4)


@pytest.mark.parametrize(("guilty", "left"), [("caller", 9), ("helpers", 8)])
def test_an_exception_comes_back_after_the_rest_is_done(guilty, left):
    done, together, caller = [], threading.Barrier(3), threading.get_ident()

    def task(i):
        if i < 3:  # one for each thread
            together.wait(20)
        if (threading.get_ident() == caller) == (guilty == "caller"):
            raise KeyError("the task's own")
        time.sleep(0.01)
        done.append(i)

    with pytest.raises(KeyError, match="the task's own"):
        threads.run_parallel(task, range(10))
    assert len(done) == left


@pytest.mark.parametrize("count", [0, 1, 1023, 1024, 2049, 20_000, 100_000])
def test_ranges_cover_every_item_once(count):
    ranges = threads.even_ranges(count)
    assert [i for first, last in ranges for i in range(first, last)] == list(range(count))
    assert len(ranges) <= 1 or min(last - first for first, last in ranges) >= 1024
