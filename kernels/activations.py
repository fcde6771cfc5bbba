"""Exposures and opacities of Gaussians from their parameters, one launch each way in place of torch's four and five."""

from functools import cache

import warp as wp

from .compile_options import NO_AUTODIFF


@cache
def exposures_kernel(dtype):
    """Return the kernel of exp(values), values clamped to [-bound, bound]; NaN stays NaN. Launched over the numbers."""
    real = dtype

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def activate_exposures(
        first: int,
        values: wp.array(dtype=real), bound: real, exposures: wp.array(dtype=real),
    ):
        place = first + wp.tid()
        value = values[place]
        # Not clamped, which would make a number of what is none.
        clamped = wp.where(value > bound, bound, wp.where(value < -bound, -bound, value))
        exposures[place] = wp.exp(clamped)

    return activate_exposures


@cache
def exposures_backward_kernel(dtype):
    """Write grad_values [N C], flat, from exposure_gradients [N, C] of any strides; 0 from the bounds on."""
    real = dtype

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def activate_exposures_backward(
        first: int,
        values: wp.array(dtype=real), bound: real, exposures: wp.array(dtype=real),
        exposure_gradients: wp.array2d(dtype=real), grad_values: wp.array(dtype=real),
    ):
        place = first + wp.tid()
        i = place // exposure_gradients.shape[1]
        gradient = exposure_gradients[i, place - i * exposure_gradients.shape[1]] * exposures[place]
        value = values[place]
        grad_values[place] = wp.where(value >= bound or value <= -bound, real(0.0), gradient)

    return activate_exposures_backward


@cache
def opacities_kernel(dtype):
    """Return the kernel of sigmoids and of the shares of `weight` times their mean, launched over T threads.

    opacities: [N] sigmoids of the logits. shares: [T], each thread's part of the weighted mean. active_count: [1]
    number of Gaussians that the mean counts, of which those behind have an opacity of 0; None for all.
    """
    real = dtype

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def activate_opacities(
        first: int,
        logits: wp.array(dtype=real), weight: real, active_count: wp.array(dtype=wp.int32),
        opacities: wp.array(dtype=real), shares: wp.array(dtype=real),
    ):
        thread = first + wp.tid()
        part = weight / real(logits.shape[0])
        if active_count:
            part = weight / real(active_count[0])
        total = real(0.0)
        for i in range(thread, logits.shape[0], shares.shape[0]):
            opacity = real(1.0) / (real(1.0) + wp.exp(-logits[i]))
            total += opacity
            opacities[i] = opacity
        shares[thread] = total * part

    return activate_opacities


@cache
def opacities_backward_kernel(dtype):
    """Return the backward pass of opacities_kernel(), launched over N threads.

    logit_gradients: [N] from opacity_gradients [N] and mean_gradient [1], either of which may be None. active_count: as
    of opacities_kernel().
    """
    real = dtype

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def activate_opacities_backward(
        first: int,
        opacities: wp.array(dtype=real), weight: real, active_count: wp.array(dtype=wp.int32),
        opacity_gradients: wp.array(dtype=real), mean_gradient: wp.array(dtype=real),
        logit_gradients: wp.array(dtype=real),
    ):
        i = first + wp.tid()
        gradient = real(0.0)
        if opacity_gradients:
            gradient = opacity_gradients[i]
        if mean_gradient:
            part = weight / real(opacities.shape[0])
            if active_count:
                part = weight / real(active_count[0])
            gradient += part * mean_gradient[0]
        opacity = opacities[i]
        logit_gradients[i] = gradient * opacity * (real(1.0) - opacity)

    return activate_opacities_backward
