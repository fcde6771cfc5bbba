"""Copies between the fixed memory of a CUDA graph and tensors of its callers, which it finds in a table of addresses.

A thread copies PER_THREAD numbers. An address of 0 means that the caller has no such tensor.
"""

import warp as wp

from .constants import NO_AUTODIFF

INPUTS, OUTPUTS = 7, 5
"""Largest numbers of tensors that a graph reads and writes."""
TABLE_SIZE = INPUTS + OUTPUTS + 1
"""Length of the table: the addresses of inputs, then of outputs, then of memory to fill with zeros."""

STRIDE = 256  # Distance between the numbers of a thread, so that neighbouring threads copy neighbouring numbers
PER_THREAD = 4


def threads_for(count: int) -> int:
    """Return how many threads copy this many numbers of one tensor."""
    return (count + STRIDE * PER_THREAD - 1) // (STRIDE * PER_THREAD) * STRIDE


_threads_for = wp.func(threads_for)


@wp.func
def first_number(i: int):
    """Return the index of the first number that thread i of a tensor copies."""
    return i // STRIDE * (STRIDE * PER_THREAD) + i % STRIDE


@wp.func
def read(addresses: wp.array(dtype=wp.uint64), entry: int, numbers: wp.array(dtype=wp.float32), i: int):
    """Copy the caller's tensor to `numbers` if thread i belongs to it; return i as counted from the next tensor."""
    count = numbers.shape[0]
    threads = _threads_for(count)
    if i >= 0 and i < threads and addresses[entry] != wp.uint64(0):
        source = wp.array(ptr=addresses[entry], shape=(count,), dtype=wp.float32)
        for k in range(PER_THREAD):
            j = first_number(i) + k * STRIDE
            if j < count:
                numbers[j] = source[j]
    return i - threads


@wp.func
def write(addresses: wp.array(dtype=wp.uint64), entry: int, numbers: wp.array(dtype=wp.float32), i: int):
    """Copy `numbers` to the caller's tensor if thread i belongs to it; return i as counted from the next tensor."""
    count = numbers.shape[0]
    threads = _threads_for(count)
    if i >= 0 and i < threads and addresses[entry] != wp.uint64(0):
        target = wp.array(ptr=addresses[entry], shape=(count,), dtype=wp.float32)
        for k in range(PER_THREAD):
            j = first_number(i) + k * STRIDE
            if j < count:
                target[j] = numbers[j]
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
def read_inputs(
    addresses: wp.array(dtype=wp.uint64),
    a: wp.array(dtype=wp.float32),
    b: wp.array(dtype=wp.float32),
    c: wp.array(dtype=wp.float32),
    d: wp.array(dtype=wp.float32),
    e: wp.array(dtype=wp.float32),
    f: wp.array(dtype=wp.float32),
    g: wp.array(dtype=wp.float32),
):
    """Copy the caller's inputs to a, b, ..., g; launch the sum of their threads_for()."""
    i = wp.tid()
    i = read(addresses, 0, a, i)
    i = read(addresses, 1, b, i)
    i = read(addresses, 2, c, i)
    i = read(addresses, 3, d, i)
    i = read(addresses, 4, e, i)
    i = read(addresses, 5, f, i)
    i = read(addresses, 6, g, i)


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def write_outputs(
    addresses: wp.array(dtype=wp.uint64),
    a: wp.array(dtype=wp.float32),
    b: wp.array(dtype=wp.float32),
    c: wp.array(dtype=wp.float32),
    d: wp.array(dtype=wp.float32),
    e: wp.array(dtype=wp.float32),
    zeros: int,
):
    """Copy a, b, ..., e to the caller's outputs, fill `zeros` numbers with 0; launch the sum of their threads_for()."""
    i = wp.tid()
    i = write(addresses, wp.static(INPUTS), a, i)
    i = write(addresses, wp.static(INPUTS + 1), b, i)
    i = write(addresses, wp.static(INPUTS + 2), c, i)
    i = write(addresses, wp.static(INPUTS + 3), d, i)
    i = write(addresses, wp.static(INPUTS + 4), e, i)
    address = addresses[wp.static(INPUTS + OUTPUTS)]
    if i >= 0 and address != wp.uint64(0):
        target = wp.array(ptr=address, shape=(zeros,), dtype=wp.float32)
        for k in range(PER_THREAD):
            j = first_number(i) + k * STRIDE
            if j < zeros:
                target[j] = 0.0
