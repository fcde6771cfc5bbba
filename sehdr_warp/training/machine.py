"""What a training asks of the machine: a device, torch's settings, the memory used, and tidy interrupts."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from ..errors import SehdrError
from ..parallel import thread_count

SWITCH_SECONDS = (
    2e-4  # A thread that waits for the interpreter asks for it after so long, where Python's 5 ms are a kernel
)


def machine_figures(device: torch.device) -> dict:
    """The device's name, and the largest memory so far, bytes: of this process, and on a GPU of torch's tensors."""
    cuda = device.type == "cuda"
    figures: dict = {"device": torch.cuda.get_device_name(device) if cuda else f"cpu ({thread_count()} threads)"}
    if sys.platform != "win32":
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        figures["peak_memory_bytes"] = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if cuda:
        figures["peak_gpu_memory_bytes"] = torch.cuda.max_memory_allocated(device)
    return figures


@contextmanager
def torch_settings(deterministic: bool) -> Iterator[None]:
    """torch on one thread, so that its sums do not depend on the machine's cores, which costs nothing: the kernels have
    threads of their own, which hand on the interpreter's lock sooner. deterministic: also its sums on a GPU in a fixed
    order."""
    threads, ordered = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    memory: Any = torch.utils.deterministic
    filled = memory.fill_uninitialized_memory
    interval = sys.getswitchinterval()
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH_SECONDS)
    _keep_memory(True)
    if deterministic:
        # cuBLAS repeats itself only with a workspace of its own; it reads this when it is first used.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True)
        memory.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        sys.setswitchinterval(interval)
        _keep_memory(False)
        if deterministic:  # The call alone loads torch's compiler, two seconds.
            torch.use_deterministic_algorithms(ordered)
        memory.fill_uninitialized_memory = filled


def _keep_memory(keep: bool) -> None:
    """Whether large memory stays the process's when it is let go. A step of a training asks for what the one before let
    go, and new memory the system fills with zeros, page by page, on one thread. glibc's; nothing elsewhere."""
    if sys.platform != "linux":
        return
    import ctypes

    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim"):
        mmap_max, trim_threshold = -4, -1
        libc.mallopt(mmap_max, 0 if keep else 1 << 16)
        libc.mallopt(trim_threshold, 2**31 - 1 if keep else 1 << 17)
        if not keep:
            libc.malloc_trim(0)


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """An event that the first signal to end (Ctrl-C, SLURM's and containers' SIGTERM, the SIGHUP of a terminal that
    closes) sets, so that a step is never cut in two. It takes effect when the block ends, a second one at once."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    signals = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    # What nohup or a shell's background ignores stays ignored.
    previous = {each: kept for each in signals if (kept := signal.getsignal(each)) not in (signal.SIG_IGN, None)}
    caught = []

    def restore():
        for each, handler in previous.items():
            signal.signal(each, handler)

    def on_signal(number, _):
        caught.append(number)
        event.set()
        restore()

    for each in previous:
        signal.signal(each, on_signal)
    try:
        yield event
    except Exception:
        caught.clear()  # What went wrong is to be told.
        raise
    finally:
        restore()
        if caught:
            signal.raise_signal(caught[0])


def summary_writer() -> type:
    """TensorBoard's; SehdrError where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise SehdrError("TensorBoard is not installed; run `pip install sehdr-warp[tensorboard]`") from None
    return SummaryWriter
