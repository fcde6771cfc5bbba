"""Capture torch operations and Warp launches as one CUDA graph.

A training step is some sixty kernels of a few microseconds each: launched one by one, the host takes several times as
long as the GPU. Captured once and replayed, the GPU sets the pace.
"""

import gc
import threading
import weakref
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, TypeVar

import torch
import warp as wp

from ..warp_launch.launching import torch_stream

T = TypeVar("T")

IDLE_BYTES = 1 << 30
"""If more of torch's memory than this is idle, it is freed before a capture: a graph has memory of its own, and during
a capture torch can free nothing."""

_one_capture = threading.RLock()  # Held during a capture, which switches off the garbage collector of all threads


@contextmanager
def _no_collection():
    """Switch off garbage collection within the block.

    A graph that only the collector frees (trainings live in reference cycles) frees its memory too, and in the middle
    of another capture that invalidates both.
    """
    restore = gc.enable if gc.isenabled() else gc.disable
    gc.disable()
    try:
        yield
    finally:
        restore()


def _one_thread():
    """Run backward passes on this thread.

    Torch's own thread frees a graph some time later, also in the middle of a capture.
    """
    return torch.autograd.set_multithreading_enabled(False)


def is_capturing(device: torch.device) -> bool:
    """Return whether launches on a device are being captured in a CUDA graph instead of run."""
    return device.type == "cuda" and torch._C._cuda_isCurrentStreamCapturing()  # torch.cuda has it one frame deeper.


_replays_are_off: ContextVar[bool] = ContextVar("replays_are_off", default=False)


@contextmanager
def without_replays() -> Iterator[None]:
    """Launch this thread's renders within the block; cache.py else gives them graphs of 0.4 kB for a Gaussian."""
    token = _replays_are_off.set(True)
    try:
        yield
    finally:
        _replays_are_off.reset(token)


replays_are_off: Callable[[], bool] = _replays_are_off.get  # Whether this is within without_replays()


idle_streams: dict[torch.device, list[torch.cuda.Stream]] = {}
"""Streams whose owner is gone, for own_stream()."""


def own_stream(owner, device: torch.device) -> torch.cuda.Stream:
    """Return a stream on which nothing else captures for as long as its owner lives.

    Torch hands out 32 streams in turn, and in some versions the end of one capture frees the cuBLAS workspace of every
    other graph on the same stream, whose replay is then an illegal access (pytorch issue 193402).
    """
    idle = idle_streams.setdefault(device, [])
    stream = idle.pop() if idle else torch.cuda.Stream(device)
    weakref.finalize(owner, idle.append, stream).atexit = False
    return stream


class CudaGraphRunner:
    """Captures a function without arguments, torch operations and Warp launches alike, as a CUDA graph and replays it.

    The function works on fixed memory: it must read what differs between replays from tensors that are filled before.
    It must neither wait for the device nor copy from the host, and every kernel in it must have run once before. Its
    result must be tensors (or tuples of them), which the next replay overwrites.

    Args:
        device: a CUDA device.
        stream: to capture on, by default one of its own. A function that continues another graph's work, as a backward
            pass does, must be captured on the same stream.

    Raises:
        ValueError: if the device is not a CUDA device.
    """

    def __init__(self, device: torch.device | str, stream: torch.cuda.Stream | None = None) -> None:
        """Make a runner with memory of its own and, by default, a stream of its own."""
        self.device = torch.device(device)
        if self.device.type != "cuda":
            raise ValueError(f"device {self.device} has no CUDA graphs; use a GPU, or call the function itself")
        self._key = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._modules: Any = None
        self._result: Any = None
        self.stream = stream or own_stream(self, self.device)
        self._pool = torch.cuda.graph_pool_handle()
        self._idle_after_capture = 0
        # Keeps the pool's memory between captures: freed with the last graph of the pool, it would be allocated anew.
        self._anchor = self._capture(lambda: torch.zeros(1, device=self.device))

    @contextmanager
    def on_capture_stream(self) -> Iterator[None]:
        """Launch on the capture stream within the block, without replays, as work must that is captured later.

        Torch keeps the stream on which a parameter's gradient was first summed for as long as any graph of it lives,
        and a capture that meets another stream than its own is invalid.
        """
        current = torch.cuda.current_stream(self.device)
        self.stream.wait_stream(current)
        try:
            with torch.cuda.stream(self.stream), _one_thread(), without_replays():
                yield
        finally:
            current.wait_stream(self.stream)

    def invalidate(self) -> None:
        """Free the graph, because something that it holds fixed has changed."""
        self._key = self._modules = self._result = None
        if self._graph is not None:
            self._graph.reset()
            self._graph = None

    def run(self, key: Hashable, function: Callable[[], T]) -> T:
        """Replay the graph captured under `key`, after capturing `function` if there is none; return its result.

        Raises:
            RuntimeError: if the function cannot be captured.
        """
        if self._graph is None or key != self._key:
            self.capture(key, function)
        return self.replay()

    def capture(self, key: Hashable, function: Callable[[], T]) -> T:
        """Capture `function` without running it, in the place of any other graph; return what will be its result.

        Raises:
            RuntimeError: if the function cannot be captured.
        """
        self.invalidate()
        self._graph, self._modules, self._result = self._capture(function)
        self._key = key
        return self._result

    def replay(self) -> Any:
        """Run the graph; return its result."""
        assert self._graph is not None, "nothing is captured"
        self._graph.replay()
        return self._result

    def _capture(self, function: Callable):
        with _one_capture:
            return self._capture_alone(function)

    def _capture_alone(self, function: Callable):
        if self._idle() > self._idle_after_capture + IDLE_BYTES:
            with suppress(RuntimeError):  # Some versions of torch refuse while another thread captures.
                torch.cuda.empty_cache()
        graph = torch.cuda.CUDAGraph()
        current = torch.cuda.current_stream(self.device)
        self.stream.wait_stream(current)
        with _no_collection(), _one_thread(), torch.cuda.stream(self.stream), torch_stream(self.device):
            stream = wp.get_stream(wp.device_from_torch(self.device))
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            wp.capture_begin(stream=stream, external=True)
            try:
                result = function()
            except BaseException:
                # End both captures; that they are invalid is known.
                with suppress(RuntimeError):
                    wp.capture_end(stream=stream)
                with suppress(RuntimeError):
                    graph.capture_end()
                raise
            launched = wp.capture_end(stream=stream)
            graph.capture_end()
        current.wait_stream(self.stream)
        # Memory that graphs leave idle stays theirs.
        self._idle_after_capture = self._idle()
        # Warp's part of the capture holds only the modules that it launched, which must stay loaded.
        return graph, launched, result

    def _idle(self) -> int:
        """Return the bytes of the device that torch holds without using them."""
        return torch.cuda.memory_reserved(self.device) - torch.cuda.memory_allocated(self.device)
