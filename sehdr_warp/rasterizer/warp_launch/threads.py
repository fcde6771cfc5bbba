"""Warp's CPU launches spread over threads.

Warp runs a CPU kernel as one serial loop, so independent ranges of one launch run side by side, on the OpenMP threads
that torch has, with nothing of it in the interpreter (kernels/shared_ranges.py). No range writes what another writes,
so results do not depend on the number of threads.
"""

import ctypes
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ...kernels import shared_ranges
from ...parallel import thread_count
from .loading import launch_object

RANGES_PER_THREAD = 8
"""Threads do not end together: whoever is done earlier takes another one."""


def share(function: Any, bounds: ctypes.Structure, structures: Sequence[ctypes.Structure], ranges: Tensor) -> None:
    """Run a compiled kernel of the CPU over ranges, from each of [K] int32 up to the next; returns when all are done.

    bounds: Warp's, of one dimension; structures: the parameters, beginning with where a range begins, and for an
    adjoint their gradients."""
    size, places = ctypes.sizeof(structures[0]), [ctypes.addressof(part) for part in structures]
    if size > shared_ranges.LARGEST:
        raise ValueError(f"a kernel has {size} bytes of parameters; ranges are shared with {shared_ranges.LARGEST}")
    count, threads = len(ranges) - 1, thread_count()
    kernel = ctypes.cast(function, ctypes.c_void_p)
    given, gradients = (*places, 0)[:2]
    work = shared_ranges.Work(kernel, ctypes.addressof(bounds), given, gradients, size, ranges.data_ptr(), count)
    once = _share_ranges()

    def take_part(fork: int = 0) -> None:
        arguments = shared_ranges.Arguments(ctypes.addressof(work), fork, threads)
        once.hooks.forward(ctypes.byref(once.params[0]), ctypes.byref(arguments))

    if min(count, threads) < 2:
        take_part()
    elif fork := _fork():
        take_part(fork)
    else:
        helpers = [_helpers(threads - 1).submit(take_part) for _ in range(threads - 1)]
        try:
            take_part()
        finally:
            # No thread may still be at work when the caller goes on; one that has not begun finds nothing left to do.
            wait([helper for helper in helpers if not helper.cancel()])


@cache
def _share_ranges() -> Any:
    """share_ranges() as Warp launches it once."""
    return launch_object(shared_ranges.share_ranges, 1, [0, 0, 0], wp.get_device("cpu"))


@cache
def _fork() -> int:
    """The place of GOMP_parallel() in the OpenMP library that torch has loaded; 0 where there is none, as on Windows.
    Other libraries than GNU's have it too, for its sake."""
    for library in (Path(torch.__file__).parent / "lib").glob("libtorch_cpu.*"):
        try:
            return ctypes.cast(ctypes.CDLL(str(library)).GOMP_parallel, ctypes.c_void_p).value or 0
        except (OSError, AttributeError):
            continue
    return 0


@cache
def _helpers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="sehdr-warp")


def even_ranges(count: int, smallest: int = 1024) -> Tensor:
    """[K + 1] int32: where ranges begin that cover `count` items, and where the last one ends. A few for each thread,
    each of at least `smallest` items, or else one."""
    return _even_ranges(count, max(1, min(thread_count() * RANGES_PER_THREAD, count // smallest)))


def whole(count: int) -> Tensor:
    """The one range of all `count` items, for what one thread must do."""
    return _even_ranges(count, 1)


@lru_cache
def _even_ranges(count: int, pieces: int) -> Tensor:
    return torch.arange(pieces + 1).mul(count).div(pieces, rounding_mode="floor").int()


@contextmanager
def torch_threads(device: torch.device) -> Iterator[None]:
    """torch on all threads of the CPU too, where there are some: for what no thread's share decides, each number by
    itself and no sums."""
    if device.type != "cpu":
        yield
        return
    before, count = torch.get_num_threads(), thread_count()
    if count <= max(before, 3):
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
