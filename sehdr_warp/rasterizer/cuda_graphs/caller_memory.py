"""Tensors of the caller that a CUDA graph reads from and writes to when it is replayed."""

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from ...kernels import caller_memory as kernels
from ..warp_launch.launching import launch


class CallerMemory:
    """Copies between the fixed memory of a CUDA graph and the caller's tensors, as part of the graph.

    The caller's addresses stand in a table in pinned memory, which the graph reads when it is replayed. Copies by torch
    before and after the graph would take a quarter of a call's host time. The table must not change until the graph
    has read it. This object keeps the graph's inputs alive: nothing else refers to those of a render without gradients.
    """

    def __init__(self, device: torch.device) -> None:
        """Make a table of zeros: a graph copies nothing where an address is 0."""
        self._table = torch.zeros(kernels.TABLE_SIZE, dtype=torch.int64, pin_memory=device.type == "cuda")
        self._addresses = (ctypes.c_int64 * kernels.TABLE_SIZE).from_address(self._table.data_ptr())
        self._on_device = torch.zeros(kernels.TABLE_SIZE, dtype=torch.int64, device=device)
        self._inputs: Sequence[Tensor] = ()

    def set(self, inputs: Sequence[Tensor], outputs: Sequence[Tensor], zeros: Tensor | None) -> None:
        """Set the tensors of the next replay. All are contiguous float32; the graph fills `zeros` with 0."""
        addresses, begin = self._addresses, kernels.MAX_TENSORS
        addresses[: len(inputs)] = [tensor.data_ptr() for tensor in inputs]
        addresses[begin : begin + len(outputs)] = [tensor.data_ptr() for tensor in outputs]
        addresses[-1] = 0 if zeros is None else zeros.data_ptr()

    def read(self, inputs: Sequence[Tensor]) -> None:
        """Copy the caller's inputs to these float32 tensors. Call it first in a capture."""
        # By a kernel: on an H100 the next one waits 12 us for a copy.
        launch(kernels.read_addresses, kernels.TABLE_SIZE, self._on_device, self._table)
        self._inputs = inputs
        self._copy(0, inputs, 0)

    def write(self, outputs: Sequence[Tensor], zeros: int) -> None:
        """Copy float32 tensors to the caller's outputs; fill `zeros` numbers of the caller's memory with 0."""
        self._copy(kernels.MAX_TENSORS, outputs, zeros)

    def _copy(self, entry: int, tensors: Sequence[Tensor], zeros: int) -> None:
        counts = [*(tensor.numel() for tensor in tensors), zeros]
        if sum(counts) >= 1 << 30:
            raise RuntimeError(f"{sum(counts)} numbers are too many for one launch of copies")
        arrays = [*tensors, *[None] * (kernels.MAX_TENSORS - len(tensors))]
        launch(kernels.copy_tensors, sum(map(kernels.threads_for, counts)), self._on_device, entry, zeros, *arrays)
