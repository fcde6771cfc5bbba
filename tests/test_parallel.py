"""Work that threads do ahead."""

import threading

import pytest

from sehdr_warp.parallel import prefetch_map, thread_count


@pytest.mark.parametrize("threads", ["1", "3"])
def test_order_is_kept_and_at_most_ahead_are_computed(monkeypatch, threads):
    monkeypatch.setenv("SEHDR_THREADS", threads)
    assert thread_count() == int(threads)
    begun, first_may_end = [], threading.Event()

    def make(item):
        begun.append(item)
        if item == 0 and threads != "1":
            assert first_may_end.wait(10)
        elif len(begun) == 3:
            first_may_end.set()
        return item * item

    made = prefetch_map(make, range(8), 3)
    assert next(made) == 0
    assert len(begun) <= int(threads)
    assert list(made) == [item * item for item in range(1, 8)]


def test_an_exception_comes_where_its_turn_is(monkeypatch):
    monkeypatch.setenv("SEHDR_THREADS", "4")
    made = prefetch_map(lambda item: 1 / item, [1, 2, 0, 4], 4)
    assert [next(made), next(made)] == [1, 0.5]
    with pytest.raises(ZeroDivisionError):
        next(made)
