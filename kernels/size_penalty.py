"""The penalty on angular sizes, in one launch each way."""

from functools import cache

import warp as wp

from .constants import LOG_SCALE_MAX, NO_AUTODIFF
from .geometry import vector


@cache
def _size_functions(dtype):
    real, vec3 = dtype, vector(3, dtype)

    @wp.func
    def distance_of(i: int, means: wp.array(dtype=vec3), position: wp.array(dtype=vec3), least: real) -> real:
        """Return the distance of a mean from a position [1], at least `least`."""
        return wp.max(wp.length(means[i] - position[0]), least)

    @wp.func
    def size_of(logarithm: real) -> real:
        """Return a standard deviation; like projection, none is larger than e ** LOG_SCALE_MAX."""
        return wp.exp(wp.min(logarithm, real(LOG_SCALE_MAX)))

    return distance_of, size_of


@cache
def size_penalty_kernel(dtype):
    """Return the kernel of the shares of `weight` times the mean size over distance, launched over T threads.

    log_scales: [N] vec3, logarithms of the standard deviations. means: [N] vec3. position: [1] vec3, the camera's.
    least: smallest distance that counts. active_count: [1] number of Gaussians, which are the first; None for N.
    shares: [T], each thread's part.
    """
    real, vec3 = dtype, vector(3, dtype)
    distance_of, size_of = _size_functions(dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def sum_sizes(
        range_start: int,
        log_scales: wp.array(dtype=vec3), means: wp.array(dtype=vec3), position: wp.array(dtype=vec3), least: real,
        weight: real, active_count: wp.array(dtype=wp.int32), shares: wp.array(dtype=real),
    ):
        thread = range_start + wp.tid()
        count = int(log_scales.shape[0])
        if active_count:
            count = active_count[0]
        total = real(0.0)
        for i in range(thread, count, shares.shape[0]):
            size = log_scales[i]
            total += (size_of(size[0]) + size_of(size[1]) + size_of(size[2])) / distance_of(i, means, position, least)
        shares[thread] = total * weight / (real(3.0) * real(count))

    return sum_sizes


@cache
def size_penalty_backward_kernel(dtype):
    """Return the backward pass of size_penalty_kernel(), launched over N threads.

    scale_gradients: [N] vec3 by log_scales, from penalty_gradient [1]. The other arguments are those of
    size_penalty_kernel().
    """
    real, vec3 = dtype, vector(3, dtype)
    distance_of, size_of = _size_functions(dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def sum_sizes_backward(
        range_start: int,
        log_scales: wp.array(dtype=vec3), means: wp.array(dtype=vec3), position: wp.array(dtype=vec3), least: real,
        weight: real, active_count: wp.array(dtype=wp.int32), penalty_gradient: wp.array(dtype=real),
        scale_gradients: wp.array(dtype=vec3),
    ):
        i = range_start + wp.tid()
        count = int(log_scales.shape[0])
        if active_count:
            count = active_count[0]
        factor = real(0.0)
        if i < count:
            factor = weight * penalty_gradient[0] / (real(3.0) * real(count) * distance_of(i, means, position, least))
        size = log_scales[i]
        scale_gradients[i] = factor * vec3(size_of(size[0]), size_of(size[1]), size_of(size[2]))

    return sum_sizes_backward
