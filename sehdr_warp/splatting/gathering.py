"""From gradients by (Gaussian, tile) pair to gradients by Gaussian."""

import torch
import warp as wp

from ..kernels.gather import gather_kernel
from . import threads
from .arrays import view, warp_scalar
from .bridge import torch_stream
from .tile_lists import Emission


def gather_by_gaussian(emission: Emission, by_entry: torch.Tensor) -> torch.Tensor:
    """[N, columns]: for each Gaussian the sum of its rows of by_entry [M, columns], front tile to last.

    by_entry: rows in the order in which entries were before the sort by tile.
    """
    entry_count, columns = by_entry.shape
    count = emission.order.shape[0]
    gathered = by_entry.new_zeros(count, columns)
    if not entry_count:
        return gathered
    device = wp.device_from_torch(by_entry.device)
    arguments = [
        view(emission.order),
        view(emission.ends.clamp(0, entry_count)),  # beyond a capacity there are no rows
        view(by_entry),
        columns,
        view(gathered),
    ]
    kernel = gather_kernel(warp_scalar(by_entry.dtype))
    if device.is_cpu:
        threads.launch_ranges(kernel, threads.even_ranges(count), arguments, device)
    else:
        with torch_stream(by_entry.device):
            wp.launch(kernel, dim=count, inputs=[0, *arguments], device=device, record_tape=False)
    return gathered
