"""The number of threads, and results that threads compute ahead."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def thread_count() -> int:
    """Return the threads to use on the CPU: SEHDR_THREADS if set, else the processors this process may run on."""
    requested = os.environ.get("SEHDR_THREADS", "")
    if requested.isdigit() and int(requested) > 0:
        return int(requested)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def prefetch_map(function: Callable[[Item], Result], items: Iterable[Item], ahead: int) -> Iterator[Result]:
    """Yield function(item) for each item in order, computed ahead on threads.

    It is of use if the function releases the interpreter's lock, as decoding of images does.

    Args:
        function: what is computed. Its exception is raised when the item's result is due.
        items: the items.
        ahead: results that are computed or wait to be taken, at most.
    """
    ahead = min(ahead, thread_count())
    if ahead < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(ahead, thread_name_prefix="sehdr-warp reads") as pool:
        waiting: deque = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) >= ahead:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
