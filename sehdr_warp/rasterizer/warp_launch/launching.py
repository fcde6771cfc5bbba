"""Launch kernels on torch tensors: on torch's device and stream, on the CPU spread over threads."""

import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from . import threads
from .packing import FixedLaunch, PackedLaunch

_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
_streams: dict[tuple[int, int], wp.Stream] = {}


def warp_scalar(dtype: torch.dtype) -> Any:
    """Return wp.float32 or wp.float64; raise TypeError for any other torch dtype."""
    try:
        return _SCALARS[dtype]
    except KeyError:
        raise TypeError(f"the rasterizer works in float32 and float64, not {dtype}") from None


def launch(
    kernel: Any,
    dim: int | Sequence[int],
    *arguments: Any,
    gradients: Sequence[Tensor | None] | None = None,
    ranges: Tensor | None = None,
    min_range: int = 1024,
    block_dim: int | None = None,
) -> None:
    """Launch a kernel or its adjoint over `dim` threads, without a tape and without a synchronization.

    A kernel whose first parameter is `range_start` adds it to its thread index and writes nothing that another index
    writes. On the CPU such a kernel runs in parallel over ranges of indices: PackedLaunch.launch_ranges() calls
    threads.run_ranges(), whose kernel share_ranges hands them to threads.

    Args:
        kernel: a Warp kernel.
        dim: number of threads.
        *arguments: the kernel's arguments (without `range_start`), with tensors of one device in the place of arrays. A
            vector or matrix type takes up the last one or two dimensions. A tensor with more dimensions than the
            kernel's array is passed flattened. None passes a null array, which the kernel tests for.
        gradients: for each argument its gradient or None. If given, the adjoint is launched: it reads the gradients of
            the kernel's outputs and adds to those of its inputs.
        ranges: [K + 1] int32, where ranges of indices begin and where the last one ends; by default even ones.
        min_range: least number of indices of a default range.
        block_dim: threads per block of a block kernel.
    """
    if dim == 0 or (not isinstance(dim, int) and 0 in dim):
        return
    device, values = _device_and_values(kernel, arguments, gradients)
    packed = _packed_launch(kernel, device, block_dim, gradients is not None, dim, values)
    if device.type == "cpu" and isinstance(dim, int) and takes_range_start(kernel):
        packed.launch_ranges(threads.even_ranges(dim, min_range) if ranges is None else ranges, values)
    else:
        packed.launch(dim, values, warp_stream(device))


def _device_and_values(
    kernel: Any, arguments: Sequence[Any], gradients: Sequence[Tensor | None] | None
) -> tuple[torch.device, list]:
    """Return the device, and the arguments with 0 for `range_start`, for an adjoint followed by their gradients."""
    device = next(argument.device for argument in arguments if isinstance(argument, Tensor))
    start = takes_range_start(kernel)
    values = [0, *arguments] if start else list(arguments)
    if gradients is not None:
        values += [None, *gradients] if start else gradients
    return device, values


def fixed_launch(
    kernel: Any,
    dim: int | Sequence[int],
    *arguments: Any,
    gradients: Sequence[Tensor | None] | None = None,
    strided: Sequence[Tensor] = (),
    by_address: Sequence[Tensor],
    block_dim: int | None = None,
) -> FixedLaunch:
    """Return launch()'s launch as an object, for tensors that stay where they are but for some.

    strided: tensors among arguments and gradients that each launch gives anew, with any distance from row to row.
    by_address: those whose addresses each launch gives; their layout stays. The others are launch()'s.
    """
    device, values = _device_and_values(kernel, arguments, gradients)
    packed = PackedLaunch(kernel, device, block_dim, gradients is not None, dim, values)
    return FixedLaunch(packed, dim, values, strided, by_address)


@cache
def takes_range_start(kernel: Any) -> bool:
    """Return whether the kernel's first parameter is `range_start`, the start of a range of thread indices."""
    return kernel.adj.args[0].label == "range_start"


_of_thread = threading.local()


def _packed_launch(
    kernel: Any, device: torch.device, block_dim: int | None, adjoint: bool, dim: Any, values: list
) -> PackedLaunch:
    """Return this thread's packed launch of the kernel; another thread's may be in use at the same time."""
    try:
        launches = _of_thread.launches
    except AttributeError:
        launches = _of_thread.launches = {}
    key = kernel, device, block_dim, adjoint
    packed = launches.get(key)
    if packed is None:
        packed = launches[key] = PackedLaunch(*key, dim, values)
    return packed


def torch_stream(device: torch.device) -> AbstractContextManager:
    """Return a context within which Warp itself works on torch's current stream."""
    stream = warp_stream(device)
    if stream is None or stream.device.stream is stream:
        return nullcontext()
    return wp.ScopedStream(stream, sync_enter=False, sync_exit=False)


def warp_stream(device: torch.device) -> wp.Stream | None:
    """Return Warp's object for torch's current stream; None on the CPU."""
    if device.type == "cpu":
        return None
    # One Warp object per stream, never freed: if a second one dies, Warp forgets the stream, also in mid-capture.
    key = device.index, stream_handle(device)
    stream = _streams.get(key)
    if stream is None:
        stream = _streams[key] = wp.Stream(wp.device_from_torch(device), cuda_stream=key[1])
    return stream


def stream_handle(device: torch.device) -> int:
    """Return the CUDA handle of torch's current stream, in a tenth of the time of torch.cuda.current_stream()."""
    return torch._C._cuda_getCurrentRawStream(device.index)


class _Memory:
    """The attributes that radix_sort_pairs() reads of an array; a tenth of what a wp.array costs the host."""

    is_contiguous = True

    def __init__(self, tensor: Tensor) -> None:
        self.ptr, self.size = tensor.data_ptr(), tensor.numel()
        self.dtype, self.device = wp.dtype_from_torch(tensor.dtype), wp.device_from_torch(tensor.device)


def sort_pairs(keys: Tensor, values: Tensor, count: int, bits: int | None = None) -> None:
    """Sort keys[:count] and values[:count] in place by the keys' lowest bits (all if None), stably.

    Both need memory for 2 * count numbers.
    """
    if count:
        with torch_stream(keys.device):
            wp.utils.radix_sort_pairs(_Memory(keys), _Memory(values), count, end_bit=bits)  # pyright: ignore[reportArgumentType]
