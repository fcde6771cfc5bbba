"""Keep a kernel's launch parameters packed between launches.

A launch packs only the parameters that differ from the last one, mostly addresses: a tenth of the host time of
wp.launch().
"""

import ctypes
import math
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from warp._src import context as warp_context

from . import threads
from .loading import launch_object


class _Layout(NamedTuple):
    """A tensor's layout; strides are None if it is contiguous."""

    shape: torch.Size
    strides: tuple[int, ...] | None
    dtype: torch.dtype


class PackedLaunch:
    """The packed launch of one kernel, or of its adjoint, on one device; for one thread at a time."""

    def __init__(
        self, kernel: Any, device: torch.device, block_dim: int | None, adjoint: bool, dim: Any, values: list
    ) -> None:
        """Compile or load the kernel. dim and values are of the first launch."""
        self.kernel, self.arguments = kernel.key, kernel.adj.args
        self.kinds = [argument.type for argument in self.arguments] * (1 + adjoint)
        self.packed: list[Any] = [...] * len(self.kinds)  # What the last launch packed: values, and layouts of tensors
        count = len(self.arguments)
        initial = [
            type(kind.__ctype__())() if hasattr(kind, "__ctype__") else values[index % count]
            for index, kind in enumerate(self.kinds)
        ]
        options = {"adj_inputs": initial[count:], "adjoint": adjoint, "block_dim": block_dim}
        self.command = launch_object(kernel, dim, initial[:count], wp.device_from_torch(device), **options)
        self.dim: int | Sequence[int] | None = None
        # Block kernels are left to Warp, which emulates them where there is no GPU.
        self.structures = self._structures() if device.type == "cpu" and block_dim is None else []
        # Arrays are packed where the kernel reads them.
        self.arrays = [getattr(part, name) for part in self.structures for name, *_ in part._fields_]
        self.arrays = self.arrays or self.command.params[1:]

    def launch(self, dim: int | Sequence[int], values: list, stream: wp.Stream | None) -> None:
        """Launch on a stream, or on this thread of the CPU."""
        self.prepare(dim, values)
        self.run(stream)

    def prepare(self, dim: int | Sequence[int], values: list) -> None:
        """Pack the values for run()."""
        self._pack(values)
        if dim != self.dim:
            self.command.set_dim(dim)
            self.dim = dim

    def run(self, stream: wp.Stream | None) -> None:
        """Launch what is packed on a stream, or on this thread of the CPU."""
        if self.structures:
            self._function()(*map(ctypes.byref, (self.command.params[0], *self.structures)))
        else:
            self.command.launch(stream)

    def launch_ranges(self, ranges: Tensor, values: list) -> None:
        """Launch on the CPU in parallel over ranges, whose begin is the kernel's first parameter, `range_start`."""
        self._pack(values)
        threads.run_ranges(self._function(), self.command.params[0], self.structures, ranges)

    def _function(self) -> Any:
        return self.command.hooks.backward if self.command.adjoint else self.command.hooks.forward

    def _structures(self) -> list[ctypes.Structure]:
        """Return what a CPU kernel reads: its parameters, and for an adjoint their gradients."""
        params, names = self.command.params[1:], [argument.label for argument in self.arguments]
        structures = []
        for start in range(0, len(params), len(names)):
            part = params[start : start + len(names)]
            fields = list(zip(names, map(type, part), strict=True))
            structures.append(type("Arguments", (ctypes.Structure,), {"_fields_": fields})(*part))
        return structures

    def _pack(self, values: list) -> None:
        """Pack what differs from the last launch: mostly addresses, since call sites repeat shapes."""
        arrays, packed = self.arrays, self.packed
        for index, value in enumerate(values):
            if isinstance(value, Tensor):
                array = arrays[index]
                # The shape of a contiguous tensor tells its strides.
                strides = None if value.is_contiguous() else value.stride()
                shape, dtype = value.shape, value.dtype
                last = packed[index]
                if (
                    last.__class__ is not _Layout
                    or shape != last.shape
                    or strides != last.strides
                    or dtype != last.dtype
                ):
                    write_layout(array, value, self.kinds[index], self._label(index))
                    packed[index] = _Layout(shape, strides, dtype)
                array.data = address = value.data_ptr()
                if not address and value.numel():
                    kind = type(value).__name__
                    raise TypeError(f"{self._label(index)} is a {kind}, which has no memory; pass a plain tensor")
            elif value is not packed[index] and (value is None or value != packed[index]):
                if value is not None:
                    self._set(index, value)
                elif hasattr(arrays[index], "data"):
                    arrays[index].data = arrays[index].shape[0] = 0
                packed[index] = value

    def _label(self, index: int) -> str:
        """Return a parameter's name as error messages give it."""
        is_gradient, argument = divmod(index, len(self.arguments))
        name = f"{self.kernel}(): {self.arguments[argument].label}"
        return f"the gradient of {name}" if is_gradient else name

    def _set(self, index: int, value: Any) -> None:
        self.command.set_param_at_index(index, value)
        if self.structures:
            is_gradient, argument = divmod(index, len(self.arguments))
            setattr(self.structures[is_gradient], self.arguments[argument].label, self.command.params[index + 1])


class FixedLaunch:
    """A launch whose arguments stay, but for the addresses of some tensors: a third of the host time of a packed one.

    packed: the kernel's launch, which nothing else uses. values: all arguments; those that stay are kept alive.
    strided, by_address: those of the values that each launch gives anew, see fixed_launch().
    """

    def __init__(
        self,
        packed: PackedLaunch,
        dim: int | Sequence[int],
        values: list,
        strided: Sequence[Tensor],
        by_address: Sequence[Tensor],
    ) -> None:
        """Pack the values."""
        packed.prepare(dim, values)
        moving = *strided, *by_address
        self._slots = []
        for tensor in moving:
            index = next(k for k, value in enumerate(values) if value is tensor)
            self._slots.append(_Slot(packed.arrays[index], tensor))
        self._packed, self._strided_slots = packed, self._slots[: len(strided)]
        self._on_stream = _on_stream(packed.command) if packed.command.device.is_cuda else None
        self._values = [value for value in values if not any(value is tensor for tensor in moving)]
        self._addresses: Sequence[int] = ()
        self._lock = threading.Lock()  # A retained graph may be differentiated by several threads.

    def launch(self, strided: Sequence[Tensor | None], addresses: Sequence[int], stream: wp.Stream | None) -> None:
        """Launch on tensors with the layouts of the first ones; None and address 0 are an empty array."""
        if strided:
            addresses = [0 if tensor is None else tensor.data_ptr() for tensor in strided] + list(addresses)
        with self._lock:
            for slot, tensor in zip(self._strided_slots, strided, strict=True):
                if tensor is not None and (step := tensor.stride(0)) != slot.step:
                    slot.step, slot.strides[0] = step, step * slot.size
            if addresses != self._addresses:  # Torch mostly allocates where it did for the last call.
                for slot, address in zip(self._slots, addresses, strict=True):
                    slot.array.data = address
                    if slot.is_empty is not (address == 0):
                        slot.is_empty = address == 0
                        slot.shape[0] = 0 if slot.is_empty else slot.length
                self._addresses = addresses
            # Of a launch that failed, Warp's own launch raises the error.
            if self._on_stream is None or stream is None or self._on_stream(stream.cuda_stream, None):
                self._packed.run(stream)


def _on_stream(command: Any) -> Callable[[int, None], int]:
    """Return what Warp's Launch.launch() calls for a stream, without what that looks up before; 0 if it worked."""
    hooks, adjoint = command.hooks, command.adjoint
    return partial(
        warp_context.runtime.core.wp_cuda_launch_kernel,
        ctypes.c_void_p(command.device.context),
        ctypes.c_void_p(hooks.backward if adjoint else hooks.forward),
        ctypes.c_size_t(command.bounds.size),
        ctypes.c_int(command.max_blocks),
        ctypes.c_int(command.block_dim),
        ctypes.c_int(command.grid_stride),
        ctypes.c_int(command.cluster_dim),
        ctypes.c_int(hooks.backward_smem_bytes if adjoint else hooks.forward_smem_bytes),
        command.params_addr,
    )


class _Slot:
    """A packed array that tensors of one layout take in turn.

    array is its descriptor; shape and strides (bytes) are views of it. length: shape[0] unless is_empty. step: numbers
    from row to row, as the strides have it; -1 if unknown. size: bytes of a number.
    """

    __slots__ = ("array", "is_empty", "length", "shape", "size", "step", "strides")

    def __init__(self, array: Any, tensor: Tensor) -> None:
        self.array, self.shape, self.strides = array, array.shape, array.strides
        self.length, self.is_empty = array.shape[0], False
        self.size, self.step = tensor.element_size(), -1


def write_layout(array: Any, tensor: Tensor, kind: wp.array, label: str = "the kernel") -> None:
    """Write a tensor's shape and strides into an array's descriptor; raise TypeError if the kernel takes others.

    label: what the message calls the array.
    """
    inner, scalar = getattr(kind.dtype, "_shape_", ()), getattr(kind.dtype, "_wp_scalar_type_", kind.dtype)
    size, outer = tensor.element_size(), tensor.ndim - len(inner)
    shape, steps = list(tensor.shape), [size * stride for stride in tensor.stride()]
    if tensor.is_contiguous():
        # torch leaves the stride of an axis of length 1 as it was.
        steps = [size * math.prod(shape[axis + 1 :]) for axis in range(tensor.ndim)]
    whole = [size * math.prod(inner[axis + 1 :]) for axis in range(len(inner))]
    surplus = outer - kind.ndim
    expected, dtype = wp.dtype_to_torch(scalar), tensor.dtype
    integers = not (expected.is_floating_point or dtype.is_floating_point)
    alike = dtype == expected or (integers and dtype.itemsize == expected.itemsize)
    if not alike or tuple(shape[outer:]) != tuple(inner) or steps[outer:] != whole or surplus < -1:
        actual = f"{dtype} of shape {shape} and strides {list(tensor.stride())}"
        raise TypeError(f"{label} takes {kind.ndim} dimensions of {kind.dtype.__name__}, got {actual}")
    shape, steps = shape[:outer], steps[:outer]
    if surplus > 0:
        if not tensor.is_contiguous():
            raise TypeError(
                f"{label}: a tensor of shape {list(tensor.shape)} that is not contiguous cannot be flattened"
            )
        shape, steps = [math.prod(shape[: surplus + 1]), *shape[surplus + 1 :]], steps[surplus:]
    elif surplus < 0:
        shape, steps = [1, *shape], [size * tensor.numel(), *steps]
    array.ndim = kind.ndim
    array.shape[: len(shape)], array.strides[: len(steps)] = shape, steps


def check_dimensions(kernel: Any, values: Sequence[Any]) -> None:
    """Raise TypeError for a tensor with more dimensions than its array; values are the kernel's last arguments."""
    parameters = kernel.adj.args[-len(values) :] if values else []
    for parameter, value in zip(parameters, values, strict=False):
        if isinstance(value, Tensor) and hasattr(parameter.type, "dtype"):
            expected = parameter.type.ndim + len(getattr(parameter.type.dtype, "_shape_", ()))
            if value.ndim > expected:
                raise TypeError(
                    f"{kernel.key}(): {parameter.label} takes a tensor with {expected} dimensions, "
                    f"got one of shape {list(value.shape)}"
                )
