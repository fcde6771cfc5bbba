"""Neural exposure fusion (SeHDR, equations 9 to 12) at given encoded brackets, and its backward pass.

P brackets of M colors, Q = P M points of each of the three channels, in the order [3, P, M]. The perceptron of a
channel has H hidden units: its terms of a point are read by all threads of a warp at once, or a warp's threads are its
units.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .constants import NO_AUTODIFF

POINTS_PER_THREAD = 64  # Of one hidden unit's gradients, summed before the atomics


@cache
def fusion_kernels(dtype) -> SimpleNamespace:
    """Return perceptrons, mix, mix_backward, unit_backward and point_backward for one scalar type.

    encoded, exposedness, outputs and what is made of them: [3, Q]; inner [3, 2, H], inner_bias, outer [3, H],
    outer_bias [3]: the perceptrons' weights; log_sigma: [3]; results: [M, 3].
    """
    real, options = dtype, NO_AUTODIFF
    reals, reals2d, reals3d = wp.array(dtype=real), wp.array2d(dtype=real), wp.array3d(dtype=real)

    @wp.func
    def deviation_of(encoded: real, log_sigma: real, most_log: real) -> real:
        return (encoded - real(0.5)) / wp.exp(wp.clamp(log_sigma, -most_log, most_log))

    @wp.func
    def largest_logit(
        outputs: reals2d, exposedness: reals2d,
        channel: int, pixel: int, count: int, brackets: int,
    ) -> real:
        """Return the largest logit of one color's brackets, which softmax subtracts to stay finite."""
        largest = outputs[channel, pixel] * exposedness[channel, pixel]
        for p in range(1, brackets):
            largest = wp.max(largest, outputs[channel, p * count + pixel] * exposedness[channel, p * count + pixel])
        return largest

    @wp.kernel(module="unique", module_options=options)
    def perceptrons(
        encoded: reals2d, log_sigma: reals,
        most_log: real, most: real,
        inner: reals3d, inner_bias: reals2d, outer: reals2d, outer_bias: reals, exposedness: reals2d, outputs: reals2d,
    ):
        """Write exposedness, exp(-d^2 / 2) of deviations from mid gray, and the outputs of the perceptron of both."""
        channel, point = wp.tid()
        x = encoded[channel, point]
        deviation = wp.clamp(deviation_of(x, log_sigma[channel], most_log), -most, most)
        near = wp.exp(real(-0.5) * deviation * deviation)
        output = outer_bias[channel]
        for unit in range(outer.shape[1]):
            value = inner[channel, 0, unit] * near + inner[channel, 1, unit] * x + inner_bias[channel, unit]
            output += outer[channel, unit] * wp.max(value, real(0.0))
        exposedness[channel, point] = near
        outputs[channel, point] = output

    @wp.kernel(module="unique", module_options=options)
    def mix(
        encoded: reals2d, exposedness: reals2d, outputs: reals2d,
        brackets: int, scale: real,
        results: reals2d,
    ):
        """Write scale times the mean of the encoded brackets, weighted by the softmax of outputs * exposedness."""
        pixel, channel = wp.tid()
        count = results.shape[0]
        largest = largest_logit(outputs, exposedness, channel, pixel, count, brackets)
        total = real(0.0)
        weighted = real(0.0)
        for p in range(brackets):
            q = p * count + pixel
            weight = wp.exp(outputs[channel, q] * exposedness[channel, q] - largest)
            total += weight
            weighted += weight * encoded[channel, q]
        results[pixel, channel] = scale * weighted / total

    @wp.kernel(module="unique", module_options=options)
    def mix_backward(
        encoded: reals2d, exposedness: reals2d, outputs: reals2d,
        brackets: int, scale: real,
        results: reals2d, grad_results: reals2d, grad_exposedness: reals2d, grad_output: reals2d,
    ):
        """Write the gradients; grad_exposedness is that through the logits alone."""
        pixel, channel = wp.tid()
        count = results.shape[0]
        largest = largest_logit(outputs, exposedness, channel, pixel, count, brackets)
        total = real(0.0)
        for p in range(brackets):
            q = p * count + pixel
            total += wp.exp(outputs[channel, q] * exposedness[channel, q] - largest)
        gradient = grad_results[pixel, channel]
        for p in range(brackets):
            q = p * count + pixel
            weight = wp.exp(outputs[channel, q] * exposedness[channel, q] - largest) / total
            grad_logit = gradient * weight * (scale * encoded[channel, q] - results[pixel, channel])
            grad_exposedness[channel, q] = grad_logit * outputs[channel, q]
            grad_output[channel, q] = grad_logit * exposedness[channel, q]

    @wp.kernel(module="unique", module_options=options)
    def unit_backward(
        encoded: reals2d, exposedness: reals2d, grad_output: reals2d,
        inner: reals3d, inner_bias: reals2d, outer: reals2d, points: int,
        grad_inner: reals3d, grad_inner_bias: reals2d, grad_outer: reals2d, grad_outer_bias: reals,
    ):
        """Add the gradients by the perceptrons' weights, of `points` points for each thread."""
        channel, chunk, unit = wp.tid()
        first_weight = inner[channel, 0, unit]
        second_weight = inner[channel, 1, unit]
        bias = inner_bias[channel, unit]
        outer_weight = outer[channel, unit]
        grad_first_weight = real(0.0)
        grad_second_weight = real(0.0)
        grad_bias = real(0.0)
        grad_outer_weight = real(0.0)
        output_sum = real(0.0)
        for q in range(chunk * points, wp.min((chunk + 1) * points, encoded.shape[1])):
            near = exposedness[channel, q]
            x = encoded[channel, q]
            gradient = grad_output[channel, q]
            value = first_weight * near + second_weight * x + bias
            output_sum += gradient
            if value > real(0.0):
                grad_outer_weight += gradient * value
                through = gradient * outer_weight
                grad_bias += through
                grad_first_weight += through * near
                grad_second_weight += through * x
        wp.atomic_add(grad_inner, channel, 0, unit, grad_first_weight)
        wp.atomic_add(grad_inner, channel, 1, unit, grad_second_weight)
        wp.atomic_add(grad_inner_bias, channel, unit, grad_bias)
        wp.atomic_add(grad_outer, channel, unit, grad_outer_weight)
        if unit == 0:
            wp.atomic_add(grad_outer_bias, channel, output_sum)

    @wp.kernel(module="unique", module_options=options)
    def point_backward(
        encoded: reals2d, exposedness: reals2d, grad_exposedness: reals2d, grad_output: reals2d, log_sigma: reals,
        most_log: real, most: real,
        inner: reals3d, inner_bias: reals2d, outer: reals2d, grad_log_sigma: reals2d,
    ):
        """Write grad_log_sigma [3, Q], to be summed over Q."""
        channel, point = wp.tid()
        x = encoded[channel, point]
        near = exposedness[channel, point]
        through = real(0.0)
        for unit in range(outer.shape[1]):
            weight = inner[channel, 0, unit]
            if weight * near + inner[channel, 1, unit] * x + inner_bias[channel, unit] > real(0.0):
                through += outer[channel, unit] * weight
        gradient = grad_exposedness[channel, point] + grad_output[channel, point] * through
        log = log_sigma[channel]
        deviation = deviation_of(x, log, most_log)
        result = real(0.0)
        if wp.abs(log) <= most_log and wp.abs(deviation) <= most:
            result = gradient * near * deviation * deviation
        grad_log_sigma[channel, point] = result

    return SimpleNamespace(
        perceptrons=perceptrons, mix=mix, mix_backward=mix_backward, unit_backward=unit_backward,
        point_backward=point_backward,
    )
