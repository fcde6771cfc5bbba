"""Copies between the fixed memory of a CUDA graph and tensors of its callers, which it finds in a table of addresses.

A thread copies PER_THREAD numbers. An address of 0 means that the caller has no such tensor.
"""

import warp as wp

from .constants import NO_AUTODIFF

MAX_TENSORS = 7
"""Largest number of tensors that a graph reads, and that it writes."""
TABLE_SIZE = 2 * MAX_TENSORS + 1
"""Length of the table: addresses of inputs, from MAX_TENSORS on of outputs, and last of memory to fill with zeros."""

STRIDE = 256  # Distance between the numbers of a thread, so that neighboring threads copy neighboring numbers
PER_THREAD = 4


def threads_for(count: int) -> int:
    """Return how many threads copy this many numbers of one tensor."""
    return (count + STRIDE * PER_THREAD - 1) // (STRIDE * PER_THREAD) * STRIDE


_threads_for = wp.func(threads_for)


@wp.func
def copy(address: wp.uint64, numbers: wp.array(dtype=wp.float32), count: int, reads: bool, i: int):
    """Copy `count` numbers from or to an address if thread i is one of theirs; return i as the next tensor counts it.

    Where `numbers` end, zeros are written.
    """
    threads = _threads_for(count)
    if i >= 0 and i < threads and address != wp.uint64(0):
        caller = wp.array(ptr=address, shape=(count,), dtype=wp.float32)
        first = i // STRIDE * (STRIDE * PER_THREAD) + i % STRIDE
        for k in range(PER_THREAD):
            j = first + k * STRIDE
            if j < count:
                if reads:
                    numbers[j] = caller[j]
                elif j < numbers.shape[0]:
                    caller[j] = numbers[j]
                else:
                    caller[j] = 0.0
    return i - threads


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def read_addresses(addresses: wp.array(dtype=wp.uint64), table: wp.array(dtype=wp.uint64)):
    """Copy the table, which may be in pinned memory of the host."""
    i = wp.tid()
    addresses[i] = table[i]


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def write_last(numbers: wp.array(dtype=wp.int64), result: wp.array(dtype=wp.int64)):
    """Write the last number to the result, which may be in pinned memory of the host; launch one thread."""
    result[0] = numbers[numbers.shape[0] - 1]


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def copy_tensors(
    addresses: wp.array(dtype=wp.uint64),
    entry: int,
    zeros: int,
    a: wp.array(dtype=wp.float32),
    b: wp.array(dtype=wp.float32),
    c: wp.array(dtype=wp.float32),
    d: wp.array(dtype=wp.float32),
    e: wp.array(dtype=wp.float32),
    f: wp.array(dtype=wp.float32),
    g: wp.array(dtype=wp.float32),
):
    """Copy inputs to a, ..., g if entry is 0, or these to outputs if it is MAX_TENSORS; write `zeros` zeros.

    Launch the sum of threads_for() of the lengths and of `zeros`.
    """
    i = wp.tid()
    reads = entry == 0
    i = copy(addresses[entry], a, a.shape[0], reads, i)
    i = copy(addresses[entry + 1], b, b.shape[0], reads, i)
    i = copy(addresses[entry + 2], c, c.shape[0], reads, i)
    i = copy(addresses[entry + 3], d, d.shape[0], reads, i)
    i = copy(addresses[entry + 4], e, e.shape[0], reads, i)
    i = copy(addresses[entry + 5], f, f.shape[0], reads, i)
    i = copy(addresses[entry + 6], g, g.shape[0], reads, i)
    nothing = wp.array(ptr=wp.uint64(0), shape=(0,), dtype=wp.float32)
    copy(addresses[TABLE_SIZE - 1], nothing, zeros, False, i)
