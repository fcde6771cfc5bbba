"""Copies between the memory of a CUDA graph and that of its callers, which the graph finds by their addresses.

One thread copies one number. An address of 0 is a tensor that the caller does not have.
"""

import warp as wp

from .constants import NO_AUTODIFF

INPUTS, OUTPUTS = 7, 5
"""Largest numbers of tensors that a graph reads and writes. The table has the addresses of inputs, then of outputs,
then of memory to fill with zeros."""
PLACES = INPUTS + OUTPUTS + 1


@wp.func
def read(addresses: wp.array(dtype=wp.uint64), place: int, numbers: wp.array(dtype=wp.float32), i: int):
    """Copy number i of the caller's tensor unless that ends before; return its index in the next tensor."""
    count = numbers.shape[0]
    if i >= 0 and i < count and addresses[place] != wp.uint64(0):
        numbers[i] = wp.array(ptr=addresses[place], shape=(count,), dtype=wp.float32)[i]
    return i - count


@wp.func
def write(addresses: wp.array(dtype=wp.uint64), place: int, numbers: wp.array(dtype=wp.float32), i: int):
    """Copy number i to the caller's tensor unless that ends before; return its index in the next tensor."""
    count = numbers.shape[0]
    if i >= 0 and i < count and addresses[place] != wp.uint64(0):
        target = wp.array(ptr=addresses[place], shape=(count,), dtype=wp.float32)
        target[i] = numbers[i]
    return i - count


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
    """Copy the callers' inputs to a to g; launched over all their numbers."""
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
    """Copy a to e to the callers' outputs, and fill `zeros` numbers with 0; launched over all these numbers."""
    i = wp.tid()
    i = write(addresses, wp.static(INPUTS), a, i)
    i = write(addresses, wp.static(INPUTS + 1), b, i)
    i = write(addresses, wp.static(INPUTS + 2), c, i)
    i = write(addresses, wp.static(INPUTS + 3), d, i)
    i = write(addresses, wp.static(INPUTS + 4), e, i)
    address = addresses[wp.static(INPUTS + OUTPUTS)]
    if i >= 0 and i < zeros and address != wp.uint64(0):
        target = wp.array(ptr=address, shape=(zeros,), dtype=wp.float32)
        target[i] = 0.0
