"""Warp, ready for use, and its kernels for the CPU compiled and loaded."""

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
kernel_cache.choose()
with silent_stderr():
    wp.init()
kernel_cache.check()

_loading = threading.Lock()  # Kernels that are launched are neither compiled nor loaded by two threads at once
_compilers = {fused: ThreadPoolExecutor(1, thread_name_prefix="sehdr-warp compiles") for fused in (False, True)}


def compile_for_cpu(kernel: Any) -> None:
    """Compiles a kernel for the CPU, or finds it in the cache, on a thread for those that are compiled like it: Warp
    reads its headers, which takes seconds, once on each thread for each kind."""
    check_room_to_compile()
    compiler = _compilers[uses_fused_multiply_add(kernel)]
    compiler.submit(wp.load_module, kernel.module, device="cpu").result()


def uses_fused_multiply_add(kernel: Any) -> bool:
    """Whether the compiler may fuse the kernel's multiply-adds on the CPU."""
    return FUSED in (kernel.module.options["cpu_compiler_flags"] or "")


def launch_object(kernel: Any, dim: Any, values: list, device: Any, **options: Any) -> Any:
    """Warp's launch of a kernel as an object that can be launched with other parameters. Compiles or loads it."""
    check_room_to_compile()
    if device.is_cpu:
        compile_for_cpu(kernel)
    with _loading:
        return wp.launch(kernel, dim, values, device=device, record_tape=False, record_cmd=True, **options)
