"""The one way kernels are launched: torch tensors in, on torch's device and stream, on the CPU spread over threads."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache, lru_cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..quiet import silent_stderr
from . import kernel_cache, threads

# The start-up banner, and the warning where there is no GPU, are not for a library to print.
wp.config.log_level = wp.LOG_WARNING
kernel_cache.choose()
with silent_stderr():
    wp.init()
kernel_cache.check()

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
    ranges: list[tuple[int, int]] | None = None,
    smallest: int = 1024,
    block_dim: int | None = None,
) -> None:
    """Launch a kernel over `dim` threads; no tape records it, and nothing waits for it.

    arguments: the kernel's, tensors (of one device) in the place of arrays. A vector or matrix type takes up the last
        one or two dimensions, and a tensor with more dimensions than the kernel's array is handed over flat.
    A kernel whose first parameter is `first` adds it to its thread's index and writes nothing that another index
    writes: on the CPU it runs side by side over [first, last) ranges, by default even ones of `smallest` items or more.
    """
    if dim == 0 or (not isinstance(dim, int) and 0 in dim):
        return
    ranged, types = parameters(kernel)
    device = next(argument.device for argument in arguments if isinstance(argument, Tensor))
    inputs = [
        _descriptor(argument, kind) if isinstance(argument, Tensor) else argument
        for argument, kind in zip(arguments, types, strict=True)
    ]
    if ranged and device.type == "cpu" and isinstance(dim, int):
        launch_ranges(kernel, threads.even_ranges(dim, smallest) if ranges is None else ranges, inputs)
        return
    dim = dim if isinstance(dim, int) else tuple(dim)
    inputs, where = [0, *inputs] if ranged else inputs, wp.device_from_torch(device)
    wp.launch(kernel, dim, inputs, stream=_stream(device), device=where, block_dim=block_dim, record_tape=False)


def launch_ranges(kernel: Any, ranges: list[tuple[int, int]], inputs: list, **options: Any) -> None:
    """Launch `kernel(first, *inputs)` over each [first, last) range, side by side on the CPU."""
    if len(ranges) > 1:
        wp.load_module(kernel.module, device="cpu")  # compiling is not safe from two threads at once

    def task(bounds: tuple[int, int]) -> None:
        given = [bounds[0], *inputs]
        wp.launch(kernel, dim=bounds[1] - bounds[0], inputs=given, device="cpu", record_tape=False, **options)

    threads.run_parallel(task, ranges)


@cache
def parameters(kernel: Any) -> tuple[bool, list]:
    """Whether the kernel takes the start of a range, `first`, and the types of its other parameters."""
    arguments = kernel.adj.args
    ranged = arguments[0].label == "first"
    return ranged, [argument.type for argument in arguments[ranged:]]


def _descriptor(tensor: Tensor, kind: wp.array) -> Any:
    """The tensor's memory for one launch: a tenth of what a wp.array costs the host. It keeps the tensor alive."""
    blank = _blank(tensor.shape, tensor.stride(), tensor.dtype, kind.ndim, kind.dtype)
    descriptor = type(blank).from_buffer_copy(blank)
    descriptor.data, descriptor._ref = tensor.data_ptr(), tensor
    return descriptor


@lru_cache(maxsize=4096)
def _blank(shape: torch.Size, stride: tuple[int, ...], kind: torch.dtype, dimensions: int, dtype: Any) -> Any:
    """The descriptor of such a tensor as an array of so many dimensions, without its place in memory."""
    tensor = torch.empty_strided(shape, stride, dtype=kind, device="meta")
    surplus = tensor.ndim - dimensions - len(getattr(dtype, "_shape_", ()))
    if surplus > 0:
        tensor = tensor.view(-1, *tensor.shape[surplus + 1 :])
    elif surplus < 0:
        tensor = tensor[None]
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


def sums_are_ordered(device: torch.device) -> bool:
    """Whether sums on a device must be made in a fixed order that atomics of many threads do not keep."""
    return device.type == "cuda" and torch.are_deterministic_algorithms_enabled()


def torch_stream(device: torch.device) -> AbstractContextManager:
    """Whatever Warp does goes to torch's current stream for as long as this context lasts."""
    stream = _stream(device)
    return nullcontext() if stream is None else wp.ScopedStream(stream, sync_enter=False, sync_exit=False)


def _stream(device: torch.device) -> wp.Stream | None:
    if device.type == "cpu":
        return None
    current = torch.cuda.current_stream(device)
    # One Warp object a stream, for good: when a second one dies, Warp forgets the stream, in mid-capture too.
    key = current.device_index, current.cuda_stream
    if key not in _streams:
        _streams[key] = wp.Stream(wp.device_from_torch(device), cuda_stream=current.cuda_stream)
    return _streams[key]
