"""Torch and Warp work recorded as one CUDA graph.

A training step is some sixty kernels of a few microseconds each: launched one by one, the host takes several times as
long as the GPU. Recorded once and replayed, the GPU sets the pace.
"""

import gc
import threading
import weakref
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import torch
import warp as wp

from .warp_launch.launching import torch_stream

T = TypeVar("T")

IDLE_BYTES = 1 << 30
"""If more of torch's memory than this lies idle, it is given back before a recording is made: a recording has memory of
its own, and while it is made torch can give nothing back."""

_one_at_a_time = threading.RLock()
"""Recordings of several threads: the garbage collector that one switches off is everyone's."""


@contextmanager
def _no_collection():
    """No garbage collection within this block. A recording that only the collector frees (trainings live in reference
    cycles) takes its memory along, and in the middle of another recording that spoils both."""
    restore = gc.enable if gc.isenabled() else gc.disable
    gc.disable()
    try:
        yield
    finally:
        restore()


def _one_thread():
    """Backward passes run on this thread: torch's own lets go of a graph some time later, in mid-recording too."""
    return torch.autograd.set_multithreading_enabled(False)


def is_capturing(device: torch.device) -> bool:
    """Whether what is launched on a device now is recorded instead of done."""
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


_idle_streams: dict[torch.device, list[torch.cuda.Stream]] = {}


def _own_stream(owner, device: torch.device) -> torch.cuda.Stream:
    """A stream on which nothing else records for as long as its owner lives. torch hands out 32 in turn, and in some of
    its versions the end of one recording frees the cuBLAS workspace of every other on the same stream, whose replay is
    then an illegal access (pytorch issue 193402)."""
    idle = _idle_streams.setdefault(device, [])
    stream = idle.pop() if idle else torch.cuda.Stream(device)
    weakref.finalize(owner, idle.append, stream).atexit = False
    return stream


class CudaGraphRunner:
    """Records a function of no arguments, its torch operations and Warp launches alike, and replays it.

    The function works on fixed memory: what differs between replays it must read from tensors that are filled before.
    It must neither wait for the device nor copy from the host, and every kernel in it must have run once before. Its
    result must be tensors (or tuples of them), which the next replay overwrites.

    device: a CUDA device; raises ValueError for another. stream: to record on, by default one of its own; what
    continues another recording's work, as a backward pass does, must be recorded on the same.
    """

    def __init__(self, device: torch.device | str, stream: torch.cuda.Stream | None = None) -> None:
        self.device = torch.device(device)
        if self.device.type != "cuda":
            raise ValueError(f"device {self.device} has no CUDA graphs; use a GPU, or call the function itself")
        self._key = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._modules: Any = None
        self._result: Any = None
        self.stream = stream or _own_stream(self, self.device)
        self._pool = torch.cuda.graph_pool_handle()
        self._kept = 0
        # Keeps the pool's memory between recordings: freed with the last graph of the pool, it would be allocated anew.
        self._anchor = self._record(lambda: torch.zeros(1, device=self.device))

    @contextmanager
    def launching(self) -> Iterator[None]:
        """Launches within this block go to the stream of the recordings, as must those of work that is recorded later:
        torch keeps the stream on which a parameter's gradient was first summed for as long as any graph of it lives,
        and a recording that meets another stream than its own is spoilt."""
        current = torch.cuda.current_stream(self.device)
        self.stream.wait_stream(current)
        try:
            with torch.cuda.stream(self.stream), _one_thread():
                yield
        finally:
            current.wait_stream(self.stream)

    def invalidate(self) -> None:
        """Forget the recording: something that it holds fixed has changed."""
        self._key = self._modules = self._result = None
        if self._graph is not None:
            self._graph.reset()
            self._graph = None

    def run(self, key: Hashable, function: Callable[[], T]) -> T:
        """Replay the recording made under `key`, after recording `function` if there is none; returns its result.
        Raises RuntimeError if the function cannot be recorded."""
        if self._graph is None or key != self._key:
            self.record(key, function)
        return self.replay()

    def record(self, key: Hashable, function: Callable[[], T]) -> T:
        """Record `function` without playing it, in the place of any other recording; returns what will be its result.
        Raises RuntimeError if the function cannot be recorded."""
        self.invalidate()
        self._graph, self._modules, self._result = self._record(function)
        self._key = key
        return self._result

    def replay(self) -> Any:
        """Play the recording; returns its result."""
        assert self._graph is not None, "nothing is recorded"
        self._graph.replay()
        return self._result

    def _record(self, function: Callable):
        with _one_at_a_time:
            return self._record_alone(function)

    def _record_alone(self, function: Callable):
        if self._idle() > self._kept + IDLE_BYTES:
            with suppress(RuntimeError):  # some versions of torch refuse while another thread records
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
                # Leave both recordings; that they are spoilt is no news.
                with suppress(RuntimeError):
                    wp.capture_end(stream=stream)
                with suppress(RuntimeError):
                    graph.capture_end()
                raise
            launched = wp.capture_end(stream=stream)
            graph.capture_end()
        current.wait_stream(self.stream)
        # What recordings leave idle stays theirs.
        self._kept = self._idle()
        # Warp's part of the recording is empty but for the modules that it launched, which must stay loaded.
        return graph, launched, result

    def _idle(self) -> int:
        """Bytes of the device that torch holds without using them."""
        return torch.cuda.memory_reserved(self.device) - torch.cuda.memory_allocated(self.device)
