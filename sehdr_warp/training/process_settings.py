"""Process settings of a training: torch's settings, kernels compiled ahead, memory figures, and tidy interrupts."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple

import torch

from ..errors import require_extra
from ..parallel import thread_count
from ..rasterizer.memory import return_freed_memory
from ..rasterizer.precompile import precompiled, training_kernels
from ..runs.config import Config
from ..subsets import counted

SWITCH_SECONDS = 2e-4  # Interval after which a waiting thread requests the interpreter's lock; Python's 5 ms are long

_memory: Any = torch.utils.deterministic
_blocks: list["_Settings"] = []  # For each open block of torch_settings(), the settings before the first one
_blocks_lock = threading.Lock()


def machine_figures(device: torch.device) -> dict:
    """Return the device's name and the peak memory in bytes, of this process and of torch's tensors on a GPU."""
    cuda = device.type == "cuda"
    cpu = f"cpu ({counted(thread_count(), 'thread', 'threads')})"
    figures: dict = {"device": torch.cuda.get_device_name(device) if cuda else cpu}
    if sys.platform != "win32":
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        figures["peak_memory_bytes"] = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if cuda:
        figures["peak_gpu_memory_bytes"] = torch.cuda.max_memory_allocated(device)
    return figures


def precompiling(config: Config) -> AbstractContextManager[None]:
    """Return a context that compiles, in the background, the kernels that a training will launch."""
    return precompiled(_kernels_of(config), ["scipy.spatial"])  # Half a second, at the first Gaussians' neighbors.


def precompiling_planned(config: Config, requested: Config) -> AbstractContextManager[None]:
    """Return a context like precompiling() for kernels that the plan of a requested config made necessary."""
    earlier = _kernels_of(requested)
    kernels = [kernel for kernel in _kernels_of(config) if kernel not in earlier]
    return precompiled(kernels) if kernels else nullcontext()


def _kernels_of(config: Config) -> list[Any]:
    plain = config.model.tone_map == "pixel" and not config.fusion.enabled
    return training_kernels(3 if plain else None, config.model.antialiased)


class _Settings(NamedTuple):
    """Settings of the process that a training changes."""

    threads: int
    deterministic: int  # 0 if torch's sums need no fixed order, 1 if it warns of those without, 2 if it refuses them
    fills_memory: bool  # Whether torch fills new memory while deterministic, for finding errors
    switch_interval: float  # Seconds

    @staticmethod
    def current() -> "_Settings":
        deterministic, fills = torch.get_deterministic_debug_mode(), _memory.fill_uninitialized_memory
        return _Settings(torch.get_num_threads(), deterministic, fills, sys.getswitchinterval())

    def restore(self) -> None:
        torch.set_num_threads(self.threads)
        sys.setswitchinterval(self.switch_interval)
        if self.deterministic != torch.get_deterministic_debug_mode():  # The call loads torch's compiler, 2 s.
            torch.use_deterministic_algorithms(self.deterministic > 0, warn_only=self.deterministic == 1)
        _memory.fill_uninitialized_memory = self.fills_memory


@contextmanager
def torch_settings(deterministic: bool) -> Iterator[None]:
    """Apply torch's settings for a training within this block.

    torch runs on one thread, so that its sums do not depend on the number of cores; this costs nothing, because the
    kernels have their own threads, and the interpreter's lock is handed over sooner. If `deterministic`, sums on a GPU
    have a fixed order too. Blocks may overlap, as those of two trainers that take turns: the last one that ends
    restores what the first one found.
    """
    with _blocks_lock:
        if not _blocks:
            _keep_memory(True)
        _blocks.append(_blocks[0] if _blocks else _Settings.current())
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH_SECONDS)
    if deterministic:
        # cuBLAS is deterministic only with a fixed workspace; it reads this variable at its first use.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True)
        _memory.fill_uninitialized_memory = False
    try:
        yield
    finally:
        with _blocks_lock:
            before = _blocks.pop()
            if not _blocks:
                before.restore()
                _keep_memory(False)


def _keep_memory(keep: bool) -> None:
    """Set whether glibc keeps freed large memory in the process.

    A step requests the memory that the previous one freed, and the system zeroes new memory page by page on one thread.
    Does nothing on other systems.
    """
    if sys.platform != "linux":
        return
    import ctypes

    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim"):
        mmap_max, trim_threshold = -4, -1
        libc.mallopt(mmap_max, 0 if keep else 1 << 16)
        libc.mallopt(trim_threshold, 2**31 - 1 if keep else 1 << 17)
        if not keep:
            return_freed_memory()


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Yield an event that is set by the first signal to end: SIGINT, SIGTERM or SIGHUP.

    A step is then never interrupted in the middle. The signal takes effect when the block ends, a second one at once.
    """
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    signals = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    # Signals that nohup or a background shell ignores stay ignored.
    previous = {each: old for each in signals if (old := signal.getsignal(each)) not in (signal.SIG_IGN, None)}
    signal_numbers = []

    def restore():
        for each, handler in previous.items():
            signal.signal(each, handler)

    def on_signal(number, _):
        signal_numbers.append(number)
        event.set()
        restore()

    for each in previous:
        signal.signal(each, on_signal)
    try:
        yield event
    except Exception:
        signal_numbers.clear()  # The exception is reported instead of the signal.
        raise
    finally:
        restore()
        if signal_numbers:
            signal.raise_signal(signal_numbers[0])


def summary_writer() -> type:
    """Return TensorBoard's SummaryWriter; raises SehdrError if it is not installed."""
    return require_extra("torch.utils.tensorboard", "TensorBoard is not installed", "tensorboard").SummaryWriter
