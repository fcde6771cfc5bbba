"""Gaussians that move to where others are, without the host knowing which or how many.

Those that are drawn share their opacity with their copies so that the image stays about what it was (3D Gaussian
Splatting as Markov Chain Monte Carlo, NeurIPS 2024, equation 9): of n that lie on each other each has the opacity that
makes them together as opaque as the one was, and a size that makes up for the sum of their shapes.
"""

import warp as wp

from .constants import FORWARD
from .geometry import vector

OPAQUE = 1.0 - 1.0e-6  # Logits stay finite
SMALLEST = 1.0e-3  # Times which a Gaussian may become smaller at once

_vec3 = vector(3, wp.float32)


@wp.kernel(module="unique", module_options=FORWARD)
def share_opacities(
    first: int,
    copies: wp.array(dtype=wp.int64), sums: wp.array2d(dtype=wp.float64), least: float,
    logits: wp.array(dtype=wp.float32), log_scales: wp.array(dtype=_vec3),
):
    """Makes each Gaussian with copies the n-th part of itself, n one more than they are but at most the rows of sums.
    sums: row n - 1 times the powers of an opacity, from the first on, is the denominator of equation 9. least: opacity
    that remains."""
    i = first + wp.tid()
    if copies[i] > wp.int64(0):
        parts = int(wp.min(copies[i] + wp.int64(1), wp.int64(sums.shape[0])))
        whole = wp.float64(1.0) / (wp.float64(1.0) + wp.exp(-wp.float64(logits[i])))
        whole = wp.min(whole, wp.float64(OPAQUE))
        part = wp.float64(1.0) - wp.pow(wp.float64(1.0) - whole, wp.float64(1.0) / wp.float64(parts))
        power = wp.float64(1.0)
        total = wp.float64(0.0)
        for k in range(parts):
            power *= part
            total += sums[parts - 1, k] * power
        shrink = wp.clamp(whole / total, wp.float64(SMALLEST), wp.float64(1.0))
        part = wp.clamp(part, wp.float64(least), wp.float64(OPAQUE))
        logits[i] = wp.float32(wp.log(part / (wp.float64(1.0) - part)))
        smaller = wp.float32(wp.log(shrink))
        log_scales[i] = log_scales[i] + _vec3(smaller, smaller, smaller)


@wp.kernel(module="unique", module_options=FORWARD)
def copy_rows(
    first: int,
    sources: wp.array(dtype=wp.int64), given: wp.array2d(dtype=wp.float32), values: wp.array2d(dtype=wp.float32),
):
    """values[i] = given[sources[i]] where that is not negative; a thread for each number. given may be values, where no
    row is both read and written."""
    place = first + wp.tid()
    i = place // values.shape[1]
    column = place - i * values.shape[1]
    source = int(sources[i])
    if source >= 0:
        values[i, column] = given[source, column]
