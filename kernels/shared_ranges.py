"""A launch's ranges worked through by a team of threads on the CPU, with nothing of it in the interpreter.

Work names a CPU kernel and its packed parameters, which begin with `range_start`, and the ranges that are to be done.
Each thread of the team keeps parameters of its own and takes the next range until none is left. The team is OpenMP's,
as torch has loaded it. Without OpenMP, each calling thread is a team of one, and several may call at the same time.
"""

import ctypes

import warp as wp

from .constants import NO_AUTODIFF

LARGEST = 4096
"""Bytes of a kernel's parameters."""


class Work(ctypes.Structure):
    """Work that threads share: addresses of a compiled kernel, its bounds, parameters and ranges.

    kernel, bounds, parameters, gradients: addresses of the compiled kernel, of Warp's bounds of one dimension, of the
    parameters, and for an adjoint of their gradients, else 0. size: of the parameters, bytes. ranges: address of [count
    + 1] int32, where ranges begin and where the last one ends. next: the first range that no thread has.
    """

    _fields_ = (
        ("kernel", ctypes.c_void_p), ("bounds", ctypes.c_void_p), ("parameters", ctypes.c_void_p),
        ("gradients", ctypes.c_void_p), ("size", ctypes.c_uint64), ("ranges", ctypes.c_void_p),
        ("count", ctypes.c_int64), ("next", ctypes.c_int64),
    )  # fmt: skip


class Arguments(ctypes.Structure):
    """The arguments of share_ranges(), as Warp packs them."""

    _fields_ = ("work", ctypes.c_uint64), ("gomp_parallel", ctypes.c_uint64), ("threads", ctypes.c_int32)


SHARE = f"""
    struct Work {{
        void *kernel, *bounds, *parameters, *gradients;
        uint64_t size;
        const int32_t* ranges;
        int64_t count, next;
    }};
    auto run_worker = [](void* argument) {{
        typedef wp::launch_bounds_t<1> Bounds;
        Work& work = *(Work*)argument;
        alignas(16) char parameters[{LARGEST}];
        __builtin_memcpy(parameters, work.parameters, work.size);
        Bounds bounds = *(Bounds*)work.bounds;
        for (;;) {{
            const int64_t taken = __atomic_fetch_add(&work.next, 1, __ATOMIC_RELAXED);
            if (taken >= work.count)
                return;
            const int32_t range_start = work.ranges[taken], count = work.ranges[taken + 1] - range_start;
            *(int32_t*)parameters = range_start;
            bounds.shape[0] = count;
            bounds.size = count;
            if (work.gradients)
                ((void (*)(Bounds*, void*, void*))work.kernel)(&bounds, parameters, work.gradients);
            else
                ((void (*)(Bounds*, void*))work.kernel)(&bounds, parameters);
        }}
    }};
    typedef void (*GompParallel)(void (*)(void*), void*, unsigned, unsigned);
    if (gomp_parallel)
        ((GompParallel)gomp_parallel)(run_worker, (void*)work, threads, 0);
    else
        run_worker((void*)work);
"""


@wp.func_native(SHARE)
def share(work: wp.uint64, gomp_parallel: wp.uint64, threads: wp.int32):
    """Take part in the Work at an address; see SHARE."""


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def share_ranges(work: wp.uint64, gomp_parallel: wp.uint64, threads: wp.int32):
    """Run the Work at an address. gomp_parallel: address of GOMP_parallel(), or 0."""
    share(work, gomp_parallel, threads)
