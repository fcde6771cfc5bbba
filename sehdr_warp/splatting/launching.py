"""The one way kernels are launched: torch tensors in, on torch's device and stream, on the CPU spread over threads."""

import ctypes
import math
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..kernels.constants import FUSED
from ..quiet import silent_stderr
from . import kernel_cache, threads
from .memory import check_room_to_compile

# The start-up banner, and the warning where there is no GPU, are not for a library to print.
wp.config.log_level = wp.LOG_WARNING
kernel_cache.choose()
with silent_stderr():
    wp.init()
kernel_cache.check()

_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
_streams: dict[tuple[int, int], wp.Stream] = {}
_loading = threading.Lock()  # Kernels that are launched are neither compiled nor loaded by two threads at once
_compilers = {fused: ThreadPoolExecutor(1, thread_name_prefix="sehdr-warp compiles") for fused in (False, True)}


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
    ranges: list[tuple[int, int]] | None = None,
    smallest: int = 1024,
    block_dim: int | None = None,
) -> None:
    """Launch a kernel over `dim` threads; no tape records it, and nothing waits for it.

    arguments: the kernel's, tensors (of one device) in the place of arrays. A vector or matrix type takes up the last
        one or two dimensions, and a tensor with more dimensions than the kernel's array is handed over flat.
    gradients: for each argument its gradient, or None: launches the adjoint, which reads the gradients of what the
        kernel wrote and adds to those of what it read. None as an argument is an array that it does without.
    A kernel whose first parameter is `first` adds it to its thread's index and writes nothing that another index
    writes: on the CPU it runs side by side over [first, last) ranges, by default even ones of `smallest` items or more.
    """
    if dim == 0 or (not isinstance(dim, int) and 0 in dim):
        return
    ranged = starts_at_first(kernel)
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
def starts_at_first(kernel: Any) -> bool:
    """Whether the kernel takes the start of a range, `first`."""
    return kernel.adj.args[0].label == "first"


def load_on_cpu(kernel: Any) -> None:
    """Compiles a kernel for the CPU, or finds it in the cache, on a thread for those that are compiled like it: Warp
    reads its headers, which takes seconds, once on each thread for each kind."""
    check_room_to_compile()
    compiler = _compilers[is_fused(kernel)]
    compiler.submit(wp.load_module, kernel.module, device="cpu").result()


def is_fused(kernel: Any) -> bool:
    """Whether the compiler may fuse the kernel's multiply-adds on the CPU."""
    return FUSED in (kernel.module.options["cpu_compiler_flags"] or "")


class _Packed:
    """A launch whose parameters stay packed: of the next one only what differs is packed, mostly places in memory.
    A tenth of what wp.launch() costs the host."""

    def __init__(
        self, kernel: Any, device: torch.device, block_dim: int | None, adjoint: bool, dim: Any, values: list
    ) -> None:
        check_room_to_compile()
        self.arguments = kernel.adj.args
        self.kinds = [argument.type for argument in self.arguments] * (1 + adjoint)
        self.seen: list[Any] = [None] * len(self.kinds)
        count = len(self.arguments)
        given = [
            type(kind.__ctype__())() if hasattr(kind, "__ctype__") else values[place % count]
            for place, kind in enumerate(self.kinds)
        ]
        self.recorded: Any = wp.launch(
            kernel, dim, given[:count], adj_inputs=given[count:], adjoint=adjoint,
            device=wp.device_from_torch(device), block_dim=block_dim, record_tape=False, record_cmd=True,
        )  # fmt: skip
        self.dim: int | Sequence[int] | None = None
        self.structures: list[type[ctypes.Structure]] | None = None

    def launch(self, dim: int | Sequence[int], values: list, stream: wp.Stream | None) -> None:
        self._pack(values)
        if dim != self.dim:
            self.recorded.set_dim(dim)
            self.dim = dim
        self.recorded.launch(stream)

    def launch_ranges(self, ranges: list[tuple[int, int]], values: list) -> None:
        """On the CPU, side by side; `first`, the kernel's first parameter, is where a range begins. A range needs the
        interpreter's lock, for which all threads wait, for no more than a copy of what was packed."""
        self._pack(values)
        bounds, *params = self.recorded.params
        count = len(self.arguments)
        if self.structures is None:
            kinds = [type(param) for param in params]
            names = [argument.label for argument in self.arguments]
            self.structures = [
                type("Arguments", (ctypes.Structure,), {"_fields_": list(zip(names, part, strict=True))})
                for part in (kinds[:count], kinds[count:])
                if part
            ]
        given, *gradients = (
            kind(*part) for kind, part in zip(self.structures, (params[:count], params[count:]), strict=False)
        )
        hooks = self.recorded.hooks
        function = hooks.backward if gradients else hooks.forward
        further = [ctypes.byref(part) for part in gradients]

        def task(span: tuple[int, int]) -> None:
            mine = type(given).from_buffer_copy(given)
            mine.first = span[0]
            function(ctypes.byref(type(bounds)((span[1] - span[0],))), ctypes.byref(mine), *further)

        threads.run_parallel(task, ranges)

    def _pack(self, values: list) -> None:
        packed, seen = self.recorded.params, self.seen
        for index, value in enumerate(values):
            if isinstance(value, Tensor):
                array, layout = packed[index + 1], (value.shape, value.stride(), value.dtype)
                if layout != seen[index]:
                    _lay_out(array, value, self.kinds[index])
                    seen[index] = layout
                array.data = value.data_ptr()
            elif value is None:
                if hasattr(packed[index + 1], "data"):
                    packed[index + 1].data = 0
            elif value != seen[index]:
                self.recorded.set_param_at_index(index, value)
                seen[index] = value


_of_thread = threading.local()


def _packed(kernel: Any, device: torch.device, block_dim: int | None, adjoint: bool, dim: Any, values: list) -> _Packed:
    """This thread's packed launch of the kernel: another thread's may be at work."""
    if not hasattr(_of_thread, "launches"):
        _of_thread.launches = {}
    key = kernel, device, block_dim, adjoint
    if key not in _of_thread.launches:
        if device.type == "cpu":
            load_on_cpu(kernel)
        with _loading:
            _of_thread.launches[key] = _Packed(*key, dim, values)
    return _of_thread.launches[key]


def _lay_out(array: Any, tensor: Tensor, kind: wp.array) -> None:
    """Give an array's descriptor the tensor's shape and strides. Raises TypeError where the kernel takes others."""
    inner, scalar = getattr(kind.dtype, "_shape_", ()), getattr(kind.dtype, "_wp_scalar_type_", kind.dtype)
    size, outer = tensor.element_size(), tensor.ndim - len(inner)
    shape, steps = list(tensor.shape), [size * stride for stride in tensor.stride()]
    if tensor.is_contiguous():
        # torch leaves the stride of an axis of length 1 as it was.
        steps = [size * math.prod(shape[axis + 1 :]) for axis in range(tensor.ndim)]
    whole = [size * math.prod(inner[axis + 1 :]) for axis in range(len(inner))]
    surplus = outer - kind.ndim
    expected, given = wp.dtype_to_torch(scalar), tensor.dtype
    whole_numbers = not (expected.is_floating_point or given.is_floating_point)
    alike = given == expected or (whole_numbers and given.itemsize == expected.itemsize)
    if not alike or tuple(shape[outer:]) != tuple(inner) or steps[outer:] != whole or surplus < -1:
        told = f"{given} of shape {shape} and strides {list(tensor.stride())}"
        raise TypeError(f"the kernel takes {kind.ndim} dimensions of {kind.dtype.__name__}, given is {told}")
    shape, steps = shape[:outer], steps[:outer]
    if surplus > 0:
        if not tensor.is_contiguous():
            raise TypeError(f"a tensor of shape {list(tensor.shape)} that is not contiguous cannot be handed over flat")
        shape, steps = [math.prod(shape[: surplus + 1]), *shape[surplus + 1 :]], steps[surplus:]
    elif surplus < 0:
        shape, steps = [1, *shape], [size * tensor.numel(), *steps]
    array.ndim = kind.ndim
    for axis, (length, step) in enumerate(zip(shape, steps, strict=True)):
        array.shape[axis], array.strides[axis] = length, step


@cache
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A vector of these values, which nobody may change."""
    return torch.tensor(values, dtype=dtype, device=device)


def one(like: Tensor) -> Tensor:
    """The scalar 1 on a tensor's device: where it is what a scalar is differentiated by, times() has nothing to do."""
    return constant((1.0,), like.dtype, like.device)[0]


def times(gradient: Tensor, upstream: Tensor) -> Tensor:
    """A gradient times the scalar that is the gradient by what it belongs to."""
    return gradient if upstream.data_ptr() == one(upstream).data_ptr() else gradient * upstream


def sums_are_ordered(device: torch.device) -> bool:
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
