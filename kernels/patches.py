"""Patches of an image [H, W, C] that blocks of threads own on CUDA, and the columns around them.

What a value sums of those of its channel around it is summed by columns first: each thread takes a column of numbers
from memory, which lie beside those of its neighbors, and leaves its sums in shared memory, where each value finds
those of its row. A patch's columns reach `radius` pixels beyond it on all sides. A patch has three channels at most.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

ROWS, COLUMNS, CHANNELS = 8, 32, 3  # Of a patch; its columns are pixels
BLOCK_DIM = 128  # At least what a patch reaches of a row
TURNS = ROWS * COLUMNS * CHANNELS // BLOCK_DIM  # In which threads take the values of a patch


def patches_of(height: int, width: int, channels: int) -> int:
    """Return how many patches cover an image."""
    return -(-height // ROWS) * -(-width // COLUMNS) * -(-channels // CHANNELS)


@cache
def patch_functions(radius: int) -> SimpleNamespace:
    """Return patch_of(), column_of() and value_of(), which map threads to pixels, and reach, the numbers of a row."""

    @wp.func
    def patch_of(index: int, width: int, channels: int):
        """Return a thread's block, its place there, and the top row, left pixel and first channel of its patch.

        The image is [H, width, channels].
        """
        block = index // wp.static(BLOCK_DIM)
        across = (width + wp.static(COLUMNS - 1)) // wp.static(COLUMNS)
        groups = (channels + wp.static(CHANNELS - 1)) // wp.static(CHANNELS)
        patch = block // groups
        row = patch // across
        left = (patch - row * across) * wp.static(COLUMNS)
        channel = (block - patch * groups) * wp.static(CHANNELS)
        return block, index - block * wp.static(BLOCK_DIM), row * wp.static(ROWS), left, channel

    @wp.func
    def column_of(thread: int, left: int, channel: int):
        """Pixel and channel of the column that a thread sums; both may be beyond the image."""
        pixel = thread // wp.static(CHANNELS)
        return left + pixel - wp.static(radius), channel + thread - pixel * wp.static(CHANNELS)

    @wp.func
    def value_of(thread: int, turn: int, top: int, left: int, channel: int):
        """Return which value a thread takes in one of TURNS, and where it is.

        First its row in the patch and where its sums begin there; those of what is k pixels behind are CHANNELS * k
        behind. Then its row, pixel and channel, which may be beyond the image.
        """
        index = turn * wp.static(BLOCK_DIM) + thread
        row = index // wp.static(COLUMNS * CHANNELS)
        at = index - row * wp.static(COLUMNS * CHANNELS)
        pixel = at // wp.static(CHANNELS)
        return row, at, top + row, left + pixel, channel + at - pixel * wp.static(CHANNELS)

    reach = (COLUMNS + 2 * radius) * CHANNELS
    assert reach <= BLOCK_DIM
    return SimpleNamespace(reach=reach, patch_of=patch_of, column_of=column_of, value_of=value_of)
