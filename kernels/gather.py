"""The gradients of (Gaussian, tile) pairs summed by Gaussian, in one order whatever runs when."""

from functools import cache

import warp as wp


@cache
def gather_kernel(dtype):
    """rows[order[place]] = the sum of entry_gradients over the entries of Gaussian `place`, in their order.

    order: [N] Gaussians; ends: [N] one past the last entry of each place; entry_gradients: [M, columns];
    rows: [N, columns]
    """
    real = dtype

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def gather_entries(
        first: int,
        order: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        entry_gradients: wp.array2d(dtype=real),
        columns: int,
        rows: wp.array2d(dtype=real),
    ):
        place = first + wp.tid()
        begin = int(0)
        if place > 0:
            begin = ends[place - 1]
        i = order[place]
        for column in range(columns):
            total = real(0.0)
            for entry in range(begin, ends[place]):
                total += entry_gradients[entry, column]
            rows[i, column] = total

    return gather_entries
