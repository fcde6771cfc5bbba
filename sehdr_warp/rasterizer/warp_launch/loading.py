"""Initialize Warp, as soon as this module is imported; compile and load its kernels for the CPU."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from ...kernels.constants import FUSED
from ...quiet import silent_stderr
from ..memory import check_room_to_compile
from . import kernel_cache

# The start-up banner, and the warning where there is no GPU, are not for a library to print.
wp.config.log_level = wp.LOG_WARNING
kernel_cache.select_folder()
with silent_stderr():
    wp.init()
kernel_cache.discard_damaged()

_loading = threading.Lock()  # Two threads must not compile or load kernels at the same time.


def _make_compilers() -> dict[bool, ThreadPoolExecutor]:
    return {fused: ThreadPoolExecutor(1, thread_name_prefix="sehdr-warp compiles") for fused in (False, True)}


_compilers = _make_compilers()


def _renew_after_fork() -> None:
    """Replace what a fork copied in an unusable state: executors without threads, and a lock perhaps held."""
    global _loading, _compilers
    _loading, _compilers = threading.Lock(), _make_compilers()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_after_fork)


def compile_for_cpu(kernel: Any) -> None:
    """Compile a kernel for the CPU or load it from the cache.

    Kernels with the same compiler flags are compiled on one thread, because Warp reads its headers, which takes
    seconds, once for each thread and set of flags.
    """
    check_room_to_compile()
    compiler = _compilers[uses_fused_multiply_add(kernel)]
    compiler.submit(wp.load_module, kernel.module, device="cpu").result()


def uses_fused_multiply_add(kernel: Any) -> bool:
    """Return whether the compiler may fuse the kernel's multiply-adds on the CPU."""
    return FUSED in (kernel.module.options["cpu_compiler_flags"] or "")


def launch_object(kernel: Any, dim: Any, values: list, device: Any, **options: Any) -> Any:
    """Return Warp's launch of a kernel as an object that can be launched again with other parameters.

    Compiles or loads the kernel first.
    """
    check_room_to_compile()
    if device.is_cpu:
        compile_for_cpu(kernel)
    with _loading:
        return wp.launch(kernel, dim, values, device=device, record_tape=False, record_cmd=True, **options)
