"""Gaussians that move to where others are, without the host knowing which or how many.

Those that are drawn share their opacity with their copies so that the image stays about what it was (3D Gaussian
Splatting as Markov Chain Monte Carlo, NeurIPS 2024, equation 9): of n that lie on each other each has the opacity that
makes them together as opaque as the one was, and a size that makes up for the sum of their shapes.
"""

import warp as wp

from .constants import NO_AUTODIFF
from .geometry import vector

AT_ONCE = 6  # Tensors whose rows one launch copies or scales
OPAQUE = 1.0 - 1.0e-6  # Logits stay finite
SMALLEST = 1.0e-3  # Times which a Gaussian may become smaller at once

_vec3 = vector(3, wp.float32)


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def share_opacities(
    range_start: int,
    copies: wp.array(dtype=wp.int32), sums: wp.array2d(dtype=wp.float64), least: float,
    logits: wp.array(dtype=wp.float32), log_scales: wp.array(dtype=_vec3),
):
    """Give each Gaussian with copies the opacity and size that it and its copies have together (3DGS-MCMC, equation 9).

    sums: row n - 1 times the powers of an opacity, from the first on, is the denominator for n = 1 + copies, at most
    the number of rows. least: lowest opacity.
    """
    i = range_start + wp.tid()
    if copies[i] > 0:
        parts = wp.min(copies[i] + 1, sums.shape[0])
        opacity = wp.float64(1.0) / (wp.float64(1.0) + wp.exp(-wp.float64(logits[i])))
        opacity = wp.min(opacity, wp.float64(OPAQUE))
        part = wp.float64(1.0) - wp.pow(wp.float64(1.0) - opacity, wp.float64(1.0) / wp.float64(parts))
        power = wp.float64(1.0)
        total = wp.float64(0.0)
        for k in range(parts):
            power *= part
            total += sums[parts - 1, k] * power
        shrink = wp.clamp(opacity / total, wp.float64(SMALLEST), wp.float64(1.0))
        part = wp.clamp(part, wp.float64(least), wp.float64(OPAQUE))
        logits[i] = wp.float32(wp.log(part / (wp.float64(1.0) - part)))
        smaller = wp.float32(wp.log(shrink))
        log_scales[i] = log_scales[i] + _vec3(smaller, smaller, smaller)


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def number_slots(
    range_start: int,
    dead: wp.array(dtype=wp.bool), numbers: wp.array(dtype=wp.int64), slots: wp.array(dtype=wp.int32),
):
    """Assign numbers from 0 to the slots to fill: dead Gaussians and then new rows behind them; -1 for living ones.

    numbers: running count of the dead. Launched over the rows.
    """
    i = range_start + wp.tid()
    count = dead.shape[0]
    slot = int(-1)
    if i >= count:
        slot = int(numbers[count - 1]) + i - count
    elif dead[i]:
        slot = int(numbers[i]) - 1
    slots[i] = slot


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def count_copies(
    range_start: int,
    sampled_rows: wp.array(dtype=wp.int64), total: wp.array(dtype=wp.float64), begin: wp.array(dtype=wp.int64),
    end: wp.array(dtype=wp.int64), copies: wp.array(dtype=wp.int32), changed: wp.array(dtype=wp.bool),
):
    """Count how often each row was sampled for the slots from begin[0] to end[0], and mark those rows in changed.

    Nothing is counted if total[0], the sum of the weights of the draw, is 0. Launched over sampled_rows in one range,
    because several may choose the same row.
    """
    i = range_start + wp.tid()
    if total[0] > wp.float64(0.0) and wp.int64(i) < end[0] - begin[0]:
        source = int(sampled_rows[i])
        wp.atomic_add(copies, source, 1)
        changed[source] = True


_rows = wp.array2d(dtype=wp.float32)


@wp.func
def copy_row(sources: _rows, source: int, values: _rows, row: int):
    """Copy a row of sources to a row of values."""
    for column in range(values.shape[1]):
        values[row, column] = sources[source, column]


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def copy_rows(
    range_start: int,
    slots: wp.array(dtype=wp.int32), begin: wp.array(dtype=wp.int64), end: wp.array(dtype=wp.int64),
    sampled_rows: wp.array(dtype=wp.int64), total: wp.array(dtype=wp.float64),
    sources_a: _rows, sources_b: _rows, sources_c: _rows, sources_d: _rows, sources_e: _rows, sources_f: _rows,
    values_a: _rows, values_b: _rows, values_c: _rows, values_d: _rows, values_e: _rows, values_f: _rows,
    changed: wp.array(dtype=wp.bool),
):
    """Fill rows whose slot is begin[0] + k, below end[0], with source row k or, unless it is None, sampled_rows[k].

    With sampled_rows nothing is filled if total[0] is 0. Filled rows are marked in changed, unless it is None. Sources
    may be the values themselves if no row is both read and written. One thread for each row.
    """
    row = range_start + wp.tid()
    slot = wp.int64(slots[row])
    if slot < begin[0] or slot >= end[0]:
        return
    source = int(slot - begin[0])
    if sampled_rows.shape[0] > 0:
        if not (total[0] > wp.float64(0.0)):
            return
        source = int(sampled_rows[source])
    copy_row(sources_a, source, values_a, row)
    copy_row(sources_b, source, values_b, row)
    copy_row(sources_c, source, values_c, row)
    copy_row(sources_d, source, values_d, row)
    copy_row(sources_e, source, values_e, row)
    copy_row(sources_f, source, values_f, row)
    if changed.shape[0] > 0:
        changed[row] = True


@wp.func
def scale_row(values: _rows, row: int, factor: float):
    """Multiply a row of values by a factor; 0 also clears what is not finite."""
    for column in range(values.shape[1]):
        values[row, column] = wp.where(factor == 0.0, 0.0, factor * values[row, column])


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def scale_rows(
    range_start: int,
    which: wp.array(dtype=wp.bool), factor: float, a: _rows, b: _rows, c: _rows, d: _rows, e: _rows, f: _rows,
):
    """Multiply the rows that are marked by a factor. A thread for each."""
    row = range_start + wp.tid()
    if which[row]:
        scale_row(a, row, factor)
        scale_row(b, row, factor)
        scale_row(c, row, factor)
        scale_row(d, row, factor)
        scale_row(e, row, factor)
        scale_row(f, row, factor)
