"""The one way kernels are launched: torch tensors in, on torch's device and stream, on the CPU spread over threads."""

import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from . import threads
from .packing import PackedLaunch

_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
_streams: dict[tuple[int, int], wp.Stream] = {}


def warp_scalar(dtype: torch.dtype) -> Any:
    """wp.float32 or wp.float64; raises TypeError for any other torch dtype."""
    if dtype not in _SCALARS:
        raise TypeError(f"splatting works in float32 and float64, not {dtype}")
    return _SCALARS[dtype]


def launch(
    kernel: Any,
    dim: int | Sequence[int],
    *arguments: Any,
    gradients: Sequence[Tensor | None] | None = None,
    ranges: Tensor | None = None,
    smallest: int = 1024,
    block_dim: int | None = None,
) -> None:
    """Launch a kernel over `dim` threads; no tape records it, and nothing waits for it.

    arguments: the kernel's, tensors (of one device) in the place of arrays. A vector or matrix type takes up the last
        one or two dimensions, and a tensor with more dimensions than the kernel's array is handed over flat.
    gradients: for each argument its gradient, or None: launches the adjoint, which reads the gradients of what the
        kernel wrote and adds to those of what it read. None as an argument is an array that it does without.
    A kernel whose first parameter is `first` adds it to its thread's index and writes nothing that another index
    writes: on the CPU it runs side by side over ranges, from each of [K] int32 up to the next, by default even ones of
    `smallest` items or more.
    """
    if dim == 0 or (not isinstance(dim, int) and 0 in dim):
        return
    ranged = takes_range_start(kernel)
    device = next(argument.device for argument in arguments if isinstance(argument, Tensor))
    values = list(arguments)
    if gradients is not None:
        values += [None, *gradients] if ranged else gradients
    adjoint = gradients is not None
    if ranged and device.type == "cpu" and isinstance(dim, int):
        ranges = threads.even_ranges(dim, smallest) if ranges is None else ranges
        values = [0, *values]
        _packed(kernel, device, block_dim, adjoint, dim, values).launch_ranges(ranges, values)
        return
    values = [0, *values] if ranged else values
    _packed(kernel, device, block_dim, adjoint, dim, values).launch(dim, values, _stream(device))


@cache
def takes_range_start(kernel: Any) -> bool:
    """Whether the kernel takes the start of a range, `first`."""
    return kernel.adj.args[0].label == "first"


_of_thread = threading.local()


def _packed(
    kernel: Any, device: torch.device, block_dim: int | None, adjoint: bool, dim: Any, values: list
) -> PackedLaunch:
    """This thread's packed launch of the kernel: another thread's may be at work."""
    if not hasattr(_of_thread, "launches"):
        _of_thread.launches = {}
    key = kernel, device, block_dim, adjoint
    if key not in _of_thread.launches:
        _of_thread.launches[key] = PackedLaunch(*key, dim, values)
    return _of_thread.launches[key]


@cache
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A vector of these values, which nobody may change."""
    return torch.tensor(values, dtype=dtype, device=device)


def one(like: Tensor) -> Tensor:
    """The scalar 1 on a tensor's device: where it is what a scalar is differentiated by, scale_gradient() has nothing
    to do."""
    return constant((1.0,), like.dtype, like.device)[0]


def scale_gradient(gradient: Tensor, upstream: Tensor) -> Tensor:
    """A gradient times the scalar that is the gradient by what it belongs to."""
    return gradient if upstream.data_ptr() == one(upstream).data_ptr() else gradient * upstream


def requires_ordered_sums(device: torch.device) -> bool:
    """Whether sums on a device must be made in a fixed order that atomics of many threads do not keep."""
    return device.type == "cuda" and torch.are_deterministic_algorithms_enabled()


def torch_stream(device: torch.device) -> AbstractContextManager:
    """Whatever Warp does goes to torch's current stream for as long as this context lasts."""
    stream = _stream(device)
    if stream is None or stream.device.stream is stream:
        return nullcontext()
    return wp.ScopedStream(stream, sync_enter=False, sync_exit=False)


def _stream(device: torch.device) -> wp.Stream | None:
    if device.type == "cpu":
        return None
    # One Warp object a stream, for good: when a second one dies, Warp forgets the stream, in mid-capture too.
    key = device.index, stream_handle(device)
    if key not in _streams:
        _streams[key] = wp.Stream(wp.device_from_torch(device), cuda_stream=key[1])
    return _streams[key]


def stream_handle(device: torch.device) -> int:
    """CUDA's handle of torch's current stream, in a tenth of the time that torch.cuda.current_stream() takes."""
    return torch._C._cuda_getCurrentRawStream(device.index)
