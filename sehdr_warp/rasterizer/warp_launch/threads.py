"""Spread Warp's CPU launches over threads.

Warp runs a CPU kernel as one serial loop, so independent ranges of one launch run in parallel, on the OpenMP threads
that torch has and without the interpreter (kernels/shared_ranges.py). No range writes what another writes, so results
do not depend on the number of threads.
"""

import ctypes
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from ...kernels import shared_ranges
from ...parallel import thread_count
from .loading import launch_object

RANGES_PER_THREAD = 8  # Ranges differ in work, so a thread that finishes early takes another one

_forked = False
"""True if this process was forked from one that had loaded this module: OpenMP's threads are then gone for good."""


def _after_fork() -> None:
    global _forked
    _forked = True
    torch.set_num_threads(1)  # Torch's own parallel loops would wait for the same threads.


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def run_ranges(function: Any, bounds: ctypes.Structure, structures: Sequence[ctypes.Structure], ranges: Tensor) -> None:
    """Run a compiled CPU kernel over ranges of thread indices, and return when all are done.

    Args:
        function: the compiled kernel or its adjoint.
        bounds: Warp's launch bounds, of one dimension.
        structures: the kernel's parameters, of which the first is where a range begins, and for an adjoint their
            gradients.
        ranges: [K + 1] int32, where ranges begin and where the last one ends.
    """
    size, addresses = ctypes.sizeof(structures[0]), [ctypes.addressof(part) for part in structures]
    if size > shared_ranges.LARGEST:
        raise ValueError(f"a kernel has {size} bytes of parameters; ranges are shared with {shared_ranges.LARGEST}")
    count, threads = len(ranges) - 1, 1 if _forked else thread_count()
    kernel = ctypes.cast(function, ctypes.c_void_p)
    parameters, gradients = (*addresses, 0)[:2]
    work = shared_ranges.Work(kernel, ctypes.addressof(bounds), parameters, gradients, size, ranges.data_ptr(), count)
    share = _share_ranges()

    def run_worker(gomp_parallel: int = 0) -> None:
        arguments = shared_ranges.Arguments(ctypes.addressof(work), gomp_parallel, threads)
        share.hooks.forward(ctypes.byref(share.params[0]), ctypes.byref(arguments))

    if min(count, threads) < 2:
        run_worker()
    elif gomp_parallel := openmp_parallel():
        run_worker(gomp_parallel)
    else:
        helpers = [_helpers(threads - 1).submit(run_worker) for _ in range(threads - 1)]
        try:
            run_worker()
        finally:
            # No thread may still be at work when the caller goes on; one that has not begun finds nothing left to do.
            wait([helper for helper in helpers if not helper.cancel()])


@cache
def _share_ranges() -> Any:
    """Return Warp's launch object of the kernel share_ranges(), which is launched once by each call."""
    return launch_object(shared_ranges.share_ranges, 1, [0, 0, 0], wp.get_device("cpu"))


@cache
def openmp_parallel() -> int:
    """Return the address of GOMP_parallel() in torch's OpenMP library, or 0 if it has none, as on Windows.

    OpenMP libraries other than GNU's export it too.
    """
    for library in (Path(torch.__file__).parent / "lib").glob("libtorch_cpu.*"):
        try:
            return ctypes.cast(ctypes.CDLL(str(library)).GOMP_parallel, ctypes.c_void_p).value or 0
        except (OSError, AttributeError):
            continue
    return 0


@cache
def _helpers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="sehdr-warp")


def even_ranges(count: int, min_range: int = 1024) -> Tensor:
    """Return [K + 1] int32, where even ranges of `count` indices begin and where the last one ends.

    There are a few ranges for each thread, each of at least `min_range` indices, or else one.
    """
    return _even_ranges(count, max(1, min(thread_count() * RANGES_PER_THREAD, count // min_range)))


def single_range(count: int) -> Tensor:
    """Return the one range of all `count` indices, for work that one thread must do."""
    return _even_ranges(count, 1)


@lru_cache
def _even_ranges(count: int, pieces: int) -> Tensor:
    with _disable_current_modes():  # The ranges outlive the caller's modes, such as FakeTensorMode.
        return torch.arange(pieces + 1, device="cpu").mul(count).div(pieces, rounding_mode="floor").int()


@contextmanager
def torch_threads(device: torch.device) -> Iterator[None]:
    """Let torch use all threads of the CPU within the block.

    For elementwise operations only: sums would depend on the number of threads.
    """
    if device.type != "cpu":
        yield
        return
    before, count = torch.get_num_threads(), 1 if _forked else thread_count()
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
    """Let torch use one thread of the CPU within the block.

    For many small operations, between which torch's other threads would spin and take time from other work.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
