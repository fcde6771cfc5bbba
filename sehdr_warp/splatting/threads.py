"""Warp's CPU launches spread over threads.

Warp runs a CPU kernel as one serial loop and releases the interpreter's lock while it does, so independent ranges of
one launch run side by side from a thread pool (launching.py). No range writes what another writes, so results do not
depend on the number of threads.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import torch

from ..parallel import thread_count

_pool: ThreadPoolExecutor | None = None
_pool_size = 0


def run_parallel(task: Callable[[Any], object], items: Iterable[Any]) -> None:
    """Call task(item) for every item, on this thread and the pool's, and return when all are done.

    An exception ends its thread's share; those at work finish the rest, then one of the exceptions is raised here. A
    task may itself call run_parallel.
    """
    global _pool, _pool_size
    items = list(items)
    helpers = min(thread_count(), len(items)) - 1
    pending = iter(items)  # advancing a list's iterator is atomic under the interpreter's lock

    def work():
        for item in pending:
            task(item)

    if helpers < 1:
        work()
        return
    if _pool is None or _pool_size < helpers:
        _pool = ThreadPoolExecutor(helpers, thread_name_prefix="sehdr-warp")
        _pool_size = helpers
    futures = [_pool.submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        # No thread may still be at work when the caller goes on. A helper that has not begun finds nothing left to do,
        # and where this is itself a pool's thread, to wait for it could be to wait for oneself.
        begun = [future for future in futures if not future.cancel()]
        for future in begun:
            future.exception()
    for future in begun:
        future.result()


def even_ranges(count: int, smallest: int = 4096) -> list[tuple[int, int]]:
    """[first, last) ranges that cover `count` items, two for each thread; one, or each of at least `smallest`: to begin
    one takes the interpreter's lock, for which all threads wait."""
    pieces = max(1, min(thread_count() * 2, count // smallest))
    bounds = [count * k // pieces for k in range(pieces + 1)]
    return [(a, b) for a, b in pairwise(bounds) if b > a]


@contextmanager
def torch_threads() -> Iterator[None]:
    """torch on all threads too, where there are some: for what no thread's share decides, each number by itself and no
    sums."""
    before, count = torch.get_num_threads(), thread_count()
    torch.set_num_threads(max(before, count if count > 3 else 1))
    try:
        yield
    finally:
        torch.set_num_threads(before)
