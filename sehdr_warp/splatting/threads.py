"""Warp's CPU launches spread over threads.

Warp runs a CPU kernel as one serial loop and releases the interpreter's lock while it does, so independent ranges of
one launch run side by side from a thread pool (launching.py). No range writes what another writes, so results do not
depend on the number of threads.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from queue import SimpleQueue
from typing import Any

import torch

from ..parallel import thread_count

# Calls that wait for a thread, and how many threads wait for calls. A thread pool's futures would cost a launch on 16
# threads a millisecond, all of it with the interpreter's lock.
_calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
_started = 0
_starting = threading.Lock()


def run_parallel(task: Callable[[Any], object], items: Iterable[Any]) -> None:
    """Call task(item) for every item, on this thread and helpers, and return when all are done.

    An exception ends its thread's share; those at work finish the rest, then one of the exceptions is raised here. A
    task may itself call run_parallel.
    """
    items = list(items)
    helpers = min(thread_count(), len(items)) - 1
    pending = iter(items)  # advancing a list's iterator is atomic under the interpreter's lock, as is list.pop()

    def work() -> None:
        for item in pending:
            task(item)

    if helpers < 1:
        work()
        return
    leave, ended = [None] * helpers, SimpleQueue()

    def help_out() -> None:
        try:
            leave.pop()
        except IndexError:  # All is done.
            return
        error = None
        try:
            work()
        except BaseException as raised:  # noqa: BLE001 - the caller's thread raises it
            error = raised
        ended.put(error)

    begun = helpers
    try:
        _start(helpers)
        for _ in range(helpers):
            _calls.put(help_out)
        work()
    finally:
        # No thread may still be at work when the caller goes on. A helper that has not begun finds nothing left to do,
        # and where this is itself a helper, to wait for it could be to wait for oneself.
        while leave:
            try:
                leave.pop()
                begun -= 1
            except IndexError:  # The last one has just begun.
                break
        errors = [ended.get() for _ in range(begun)]
    for error in filter(None, errors):
        raise error


def _start(count: int) -> None:
    """As many threads that wait for calls, at least."""
    global _started
    with _starting:
        for number in range(_started, count):
            threading.Thread(target=_wait_for_calls, name=f"sehdr-warp {number}", daemon=True).start()
        _started = max(_started, count)


def _wait_for_calls() -> None:
    while True:
        _calls.get()()


def even_ranges(count: int, smallest: int = 1024) -> list[tuple[int, int]]:
    """[first, last) ranges that cover `count` items, two for each thread; one, or each of at least `smallest`: to begin
    one takes the interpreter's lock, for which all threads wait."""
    pieces = max(1, min(thread_count() * 2, count // smallest))
    bounds = [count * k // pieces for k in range(pieces + 1)]
    return [(a, b) for a, b in pairwise(bounds) if b > a]


@contextmanager
def torch_threads(device: torch.device) -> Iterator[None]:
    """torch on all threads of the CPU too, where there are some: for what no thread's share decides, each number by
    itself and no sums."""
    before, count = torch.get_num_threads(), thread_count()
    if device.type != "cpu" or count <= max(before, 3):
        yield
        return
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """torch on one thread of the CPU: for many small operations, between which its other threads spin and take the time
    of whatever else is at work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
