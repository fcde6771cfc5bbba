"""How many threads there are, and work that they do ahead of whoever takes it."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


def thread_count() -> int:
    """Threads used on the CPU: SEHDR_THREADS if set, else the processors this process may run on."""
    requested = os.environ.get("SEHDR_THREADS", "")
    if requested.isdigit() and int(requested) > 0:
        return int(requested)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def made_ahead(make: Callable[[Item], Made], items: Iterable[Item], most: int) -> Iterator[Made]:
    """make(item) of each item in their order, up to `most` of them at work or waiting to be taken. For what leaves the
    interpreter's lock, as decoding does. An exception comes where its item's turn is."""
    most = min(most, thread_count())
    if most < 2:
        yield from map(make, items)
        return
    with ThreadPoolExecutor(most, thread_name_prefix="sehdr-warp reads") as pool:
        waiting: deque = deque()
        try:
            for item in items:
                waiting.append(pool.submit(make, item))
                if len(waiting) >= most:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
