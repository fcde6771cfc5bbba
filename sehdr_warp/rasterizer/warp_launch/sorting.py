"""Warp's radix sort on torch's memory."""

import warp as wp
from torch import Tensor

from .launching import torch_stream


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
