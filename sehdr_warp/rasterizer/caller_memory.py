"""Inputs that a CUDA graph reads, and outputs that it writes, where the caller of its replay has them."""

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from ..kernels import caller_memory as kernels
from .warp_launch.launching import launch


class CallerMemory:
    """A table of addresses on the host, which the graph copies to the device when it is replayed.

    So the copies between the graph's memory and the caller's are part of the graph: as operations of torch they would
    take a quarter of the host's time of a call. The table must not change until the graph has read it.

    Args:
        device: of the graph.
    """

    def __init__(self, device: torch.device) -> None:
        """Make a table of zeros: a graph copies nothing where an address is 0."""
        table = torch.empty(kernels.PLACES, dtype=torch.int64, device="cpu", pin_memory=True)
        self._table, self._addresses = table, (ctypes.c_int64 * kernels.PLACES).from_address(table.data_ptr())
        self._addresses[:] = [0] * kernels.PLACES
        self._on_device = torch.zeros(kernels.PLACES, dtype=torch.int64, device=device)

    def set(self, inputs: Sequence[Tensor], outputs: Sequence[Tensor], zeros: Tensor | None) -> None:
        """Give the contiguous tensors of the next replay; zeros is memory that it fills with 0."""
        addresses = self._addresses
        addresses[: len(inputs)] = [tensor.data_ptr() for tensor in inputs]
        begin = kernels.INPUTS
        addresses[begin : begin + len(outputs)] = [tensor.data_ptr() for tensor in outputs]
        addresses[-1] = 0 if zeros is None else zeros.data_ptr()

    def read(self, inputs: Sequence[Tensor]) -> None:
        """Copy the caller's inputs to these float32 tensors; the first operation of a capture."""
        self._on_device.copy_(self._table, non_blocking=True)
        arguments = [self._on_device, *inputs, *[None] * (kernels.INPUTS - len(inputs))]
        launch(kernels.read_inputs, _total(inputs), *arguments)

    def write(self, outputs: Sequence[Tensor], zeros: int) -> None:
        """Copy float32 tensors to the caller's outputs; fill `zeros` numbers of the caller's memory with 0."""
        arguments = [self._on_device, *outputs, *[None] * (kernels.OUTPUTS - len(outputs)), zeros]
        launch(kernels.write_outputs, _total(outputs) + zeros, *arguments)


def _total(tensors: Sequence[Tensor]) -> int:
    """Return the number of elements of all tensors; raise RuntimeError if one launch cannot copy them."""
    total = sum(tensor.numel() for tensor in tensors)
    if total >= 1 << 30:
        raise RuntimeError(f"{total} numbers are too many for one launch of copies")
    return total
