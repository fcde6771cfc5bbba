"""Warp's CPU launches spread over threads.

Warp runs a CPU kernel as one serial loop and releases the interpreter's lock while it does, so independent ranges of
one launch run side by side from a thread pool. Every kernel that is launched this way takes the first index of its
range as its first argument and writes nothing that another index writes, so results do not depend on the number of
threads.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import warp as wp

_pool: ThreadPoolExecutor | None = None
_pool_size = 0


def thread_count() -> int:
    """Threads used on the CPU: SEHDR_THREADS if set, else the processors this process may run on."""
    requested = os.environ.get("SEHDR_THREADS", "")
    if requested.isdigit() and int(requested) > 0:
        return int(requested)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def run_parallel(task, items) -> None:
    """Call task(item) for every item, on the pool; the first exception is raised here."""
    global _pool, _pool_size
    items = list(items)
    threads = thread_count()
    if threads == 1 or len(items) < 2:
        for item in items:
            task(item)
        return
    if _pool is None or _pool_size != threads:
        _pool = ThreadPoolExecutor(threads, thread_name_prefix="sehdr-warp")
        _pool_size = threads
    for _ in _pool.map(task, items):
        pass


def even_ranges(count: int, smallest: int = 1024) -> list[tuple[int, int]]:
    """[first, last) ranges that cover `count` items, a few for each thread, none smaller than `smallest` but the last."""
    pieces = max(1, min(thread_count() * 4, count // smallest))
    bounds = [count * k // pieces for k in range(pieces + 1)]
    return [(a, b) for a, b in zip(bounds, bounds[1:]) if b > a]


def launch_ranges(kernel, ranges, arguments, device, block_dim: int = 256) -> None:
    """Launch `kernel(first, *arguments)` over each [first, last) range, side by side on the CPU."""
    if not ranges:
        return
    if len(ranges) > 1:
        wp.load_module(kernel.module, device=device)  # compiling is not safe from two threads at once

    def launch(bounds):
        wp.launch(kernel, dim=bounds[1] - bounds[0], inputs=[bounds[0], *arguments], device=device, record_tape=False)

    run_parallel(launch, ranges)
