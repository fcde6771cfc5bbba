"""The penalty on opacities, in one launch each way."""

from functools import cache

import warp as wp

from .constants import NO_AUTODIFF


@cache
def _penalty_functions(dtype):
    real = dtype

    @wp.func
    def weight_of_each(weight: real, count: int, active_count: wp.array(dtype=wp.int32)) -> real:
        """Return the weight over the number of Gaussians: active_count [1], or count if that is None."""
        part = weight / real(count)
        if active_count:
            part = weight / real(active_count[0])
        return part

    @wp.func
    def counts_in_penalty(i: int, extents: wp.array2d(dtype=real), moments: wp.array(dtype=real)) -> bool:
        """Return whether a Gaussian is in view or has moments; extents are None if all count."""
        counts = bool(True)
        if extents:
            counts = extents[i, 0] > real(0.0)
            if moments and moments[i] > real(0.0):
                counts = True
        return counts

    return weight_of_each, counts_in_penalty


@cache
def opacity_penalty_kernel(dtype):
    """Return the kernel of the shares of `weight` times the mean of the opacities that count, launched over T threads.

    opacities: [N]. extents: [N, 2] of projected Gaussians, 0 for those that are not in view; None if all count.
    moments: [N] Adam's second moments, with which those out of view count; None for zeros. shares: [T], each thread's
    part. active_count: [1] number that the mean divides by, of which those behind have an opacity of 0; None for N.
    """
    real = dtype
    weight_of_each, counts_in_penalty = _penalty_functions(dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def sum_opacities(
        range_start: int,
        opacities: wp.array(dtype=real), extents: wp.array2d(dtype=real), moments: wp.array(dtype=real), weight: real,
        active_count: wp.array(dtype=wp.int32), shares: wp.array(dtype=real),
    ):
        thread = range_start + wp.tid()
        total = real(0.0)
        for i in range(thread, opacities.shape[0], shares.shape[0]):
            if counts_in_penalty(i, extents, moments):
                total += opacities[i]
        shares[thread] = total * weight_of_each(weight, opacities.shape[0], active_count)

    return sum_opacities


@cache
def opacity_penalty_backward_kernel(dtype):
    """Return the backward pass of opacity_penalty_kernel(), launched over N threads.

    opacity_gradients: [N] from penalty_gradient [1]. The other arguments are those of opacity_penalty_kernel().
    """
    real = dtype
    weight_of_each, counts_in_penalty = _penalty_functions(dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def sum_opacities_backward(
        range_start: int,
        extents: wp.array2d(dtype=real), moments: wp.array(dtype=real), weight: real,
        active_count: wp.array(dtype=wp.int32), penalty_gradient: wp.array(dtype=real),
        opacity_gradients: wp.array(dtype=real),
    ):
        i = range_start + wp.tid()
        gradient = real(0.0)
        if counts_in_penalty(i, extents, moments):
            gradient = weight_of_each(weight, opacity_gradients.shape[0], active_count) * penalty_gradient[0]
        opacity_gradients[i] = gradient

    return sum_opacities_backward
