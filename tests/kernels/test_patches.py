"""Patches own each value of an image once."""

import pytest
import torch
import warp as wp

from sehdr_warp.kernels.patches import BLOCK_DIM, TURNS, patch_functions, patches_of
from sehdr_warp.rasterizer.warp_launch.launching import launch

FUNCTIONS = patch_functions(5)
patch_of, column_of, value_of = FUNCTIONS.patch_of, FUNCTIONS.column_of, FUNCTIONS.value_of
REACH = wp.constant(FUNCTIONS.reach)


@wp.kernel(module="unique", module_options={"enable_backward": False})
def count_owners(range_start: int, owners: wp.array3d(dtype=wp.int32), reached: wp.array3d(dtype=wp.int32)):
    """Count threads of each value, and patches whose rows of columns reach it."""
    _, thread, top, left, first_channel = patch_of(range_start + wp.tid(), owners.shape[1], owners.shape[2])
    for turn in range(TURNS):
        _row, _at, y, x, channel = value_of(thread, turn, top, left, first_channel)
        if y < owners.shape[0] and x < owners.shape[1] and channel < owners.shape[2]:
            wp.atomic_add(owners, y, x, channel, 1)
    x, channel = column_of(thread, left, first_channel)
    if thread < REACH and x >= 0 and x < owners.shape[1] and channel < owners.shape[2]:
        wp.atomic_add(reached, top, x, channel, 1)


@pytest.mark.parametrize("shape", [(1, 1, 1), (8, 32, 3), (9, 33, 4), (37, 70, 7), (5, 100, 3)])
def test_each_value_has_one_thread_and_what_is_around_it_is_read(device, shape):
    owners, reached = (torch.zeros(shape, dtype=torch.int32, device=device) for _ in range(2))
    threads = patches_of(*shape) * BLOCK_DIM
    launch(count_owners, threads, owners, reached, ranges=torch.tensor([0, threads], dtype=torch.int32))
    assert (owners == 1).all()
    columns = torch.arange(shape[1])
    patches = sum(((columns >= left - 5) & (columns < left + 32 + 5)).int() for left in range(0, shape[1], 32))
    assert (reached[::8].cpu() == patches[:, None]).all()
