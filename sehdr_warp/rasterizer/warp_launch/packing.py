"""Launches whose parameters stay packed: of the next one only what differs is packed, mostly places in memory. A tenth
of what wp.launch() costs the host."""

import ctypes
import math
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from . import threads
from .loading import launch_object


class PackedLaunch:
    """Of one kernel or its adjoint on one device. Not for two threads at once."""

    def __init__(
        self, kernel: Any, device: torch.device, block_dim: int | None, adjoint: bool, dim: Any, values: list
    ) -> None:
        self.arguments = kernel.adj.args
        self.kinds = [argument.type for argument in self.arguments] * (1 + adjoint)
        self.seen: list[Any] = [...] * len(self.kinds)
        count = len(self.arguments)
        given = [
            type(kind.__ctype__())() if hasattr(kind, "__ctype__") else values[place % count]
            for place, kind in enumerate(self.kinds)
        ]
        options = {"adj_inputs": given[count:], "adjoint": adjoint, "block_dim": block_dim}
        self.recorded = launch_object(kernel, dim, given[:count], wp.device_from_torch(device), **options)
        self.dim: int | Sequence[int] | None = None
        # Blocks, on fibers where there is no GPU, are left to Warp.
        self.structures = self._structures() if device.type == "cpu" and block_dim is None else []
        # Arrays are packed where the kernel reads them.
        self.arrays = [getattr(part, name) for part in self.structures for name, *_ in part._fields_]
        self.arrays = self.arrays or self.recorded.params[1:]

    def launch(self, dim: int | Sequence[int], values: list, stream: wp.Stream | None) -> None:
        """On a stream, or on this thread of the CPU."""
        self._pack(values)
        if dim != self.dim:
            self.recorded.set_dim(dim)
            self.dim = dim
        if self.structures:
            self._function()(*map(ctypes.byref, (self.recorded.params[0], *self.structures)))
        else:
            self.recorded.launch(stream)

    def launch_ranges(self, ranges: Tensor, values: list) -> None:
        """On the CPU, side by side; `first`, the kernel's first parameter, is where a range begins."""
        self._pack(values)
        threads.share(self._function(), self.recorded.params[0], self.structures, ranges)

    def _function(self) -> Any:
        return self.recorded.hooks.backward if self.recorded.adjoint else self.recorded.hooks.forward

    def _structures(self) -> list[ctypes.Structure]:
        """What a kernel of the CPU reads: its parameters, and those of the adjoint."""
        params, names = self.recorded.params[1:], [argument.label for argument in self.arguments]
        made = []
        for start in range(0, len(params), len(names)):
            part = params[start : start + len(names)]
            fields = list(zip(names, map(type, part), strict=True))
            made.append(type("Arguments", (ctypes.Structure,), {"_fields_": fields})(*part))
        return made

    def _pack(self, values: list) -> None:
        arrays, seen = self.arrays, self.seen
        for index, value in enumerate(values):
            if isinstance(value, Tensor):
                array, layout = arrays[index], (value.shape, value.stride(), value.dtype)
                if layout != seen[index]:
                    lay_out(array, value, self.kinds[index])
                    seen[index] = layout
                array.data = value.data_ptr()
            elif value is not seen[index] and (value is None or value != seen[index]):
                if value is not None:
                    self._set(index, value)
                elif hasattr(arrays[index], "data"):
                    arrays[index].data = 0
                seen[index] = value

    def _set(self, index: int, value: Any) -> None:
        self.recorded.set_param_at_index(index, value)
        if self.structures:
            part, place = divmod(index, len(self.arguments))
            setattr(self.structures[part], self.arguments[place].label, self.recorded.params[index + 1])


def lay_out(array: Any, tensor: Tensor, kind: wp.array) -> None:
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
