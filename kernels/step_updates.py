"""Work of every training step beside rendering, each in one launch: torch would make a dozen of it.

Adam (Kingma and Ba 2015) takes one thread a number. torch's fused Adam hands each block 65536 numbers: a scene of
100,000 Gaussians then keeps 90 blocks busy on a GPU that has room for thousands.
"""

from functools import cache

import warp as wp

from .constants import LOG_SCALE_MAX, NO_AUTODIFF
from .geometry import geometry, vector

SHARPNESS, CENTER = 100.0, 0.995  # 3DGS-MCMC, equation 8: noise is for Gaussians of opacity below 1 - 0.995
PARAMETERS_PER_LAUNCH = 4  # Parameters of one launch of Adam
TENSORS_PER_CHECK = 12  # Tensors of one launch that looks for what is not finite
VALUES_PER_THREAD = 4  # That one thread of the harmonics' Adam takes
SH_BLOCK = 1024  # Coefficients side by side that are updated in one turn, where they take turns
NOISE_CUTOFF = 16.0  # Exponent from which on a Gaussian's noise is below a ten-millionth, and is left out

_g = geometry(wp.float32)
_vec3, _vec4 = vector(3, wp.float32), vector(4, wp.float32)
AdamNumbers = vector(5, wp.float32)
"""1 - decay of both decays, not as float32 would round it, their logarithms, and epsilon."""
FIRST_GAIN, SECOND_GAIN, FIRST_DECAY_LOG, SECOND_DECAY_LOG, EPSILON = range(5)  # Indices of AdamNumbers


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def decide_step(
    loss: wp.array(dtype=wp.float32), finiteness: wp.array(dtype=wp.float32), overflow: wp.array(dtype=wp.bool),
    step_counters: wp.array(dtype=wp.int64), intersections: wp.array(dtype=wp.int64),
    step_flags: wp.array(dtype=wp.float32),
):
    """Decide whether a step is skipped: if its loss or a gradient is not finite, or on overflow. One thread.

    step_flags: [2], 1 or 0: skipped, applied. finiteness: [K], not all finite if a gradient is not. overflow: [1],
    whether there were more intersections than memory, or None. step_counters: [3] or None, counts steps that are not
    finite and, with intersections ([1] or None), holds the most intersections and counts the steps with overflow.
    """
    finite = wp.isfinite(loss[0])
    for i in range(finiteness.shape[0]):
        finite = finite and wp.isfinite(finiteness[i])
    complete = bool(True)
    if overflow.shape[0] > 0:
        complete = not overflow[0]
    if step_counters.shape[0] > 0:
        if not finite:
            step_counters[0] = step_counters[0] + wp.int64(1)
        if intersections.shape[0] > 0:
            step_counters[1] = wp.max(step_counters[1], intersections[0])
            if not complete:
                step_counters[2] = step_counters[2] + wp.int64(1)
    step_flags[0] = wp.where(finite and complete, 0.0, 1.0)
    step_flags[1] = 1.0 - step_flags[0]


@wp.func
def bias_correction(decay_log: float, step: float) -> float:
    """Return 1 - exp(step decay_log), without the cancellation of the first steps in float32."""
    x = step * decay_log
    correction = 1.0 - wp.exp(x)
    if x > -0.02:
        correction = -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x / 24.0)))
    return correction


_floats = wp.array(dtype=wp.float32)


@wp.func
def active_values(parameters: _floats, active_count: wp.array(dtype=wp.int32), width: int) -> int:
    """Return how many numbers to update: those of the first active_count[0] rows of `width`, or all if it is None."""
    count = parameters.shape[0]
    if active_count.shape[0] > 0 and width > 0:
        count = wp.min(count, active_count[0] * width)
    return count


@wp.func
def step_by_adam(
    i: int, active_count: wp.array(dtype=wp.int32), width: int, adam: AdamNumbers,
    gradients: _floats, step: _floats, rate: _floats,
    parameters: _floats, first_moments: _floats, second_moments: _floats,
):
    """One step of number i, in place, if it is among the active ones."""
    if i < active_values(parameters, active_count, width):
        gradient = gradients[i]
        mean = first_moments[i] + adam[FIRST_GAIN] * (gradient - first_moments[i])
        square = second_moments[i] + adam[SECOND_GAIN] * (gradient * gradient - second_moments[i])
        first_moments[i] = mean
        second_moments[i] = square
        deviation = wp.sqrt(square / bias_correction(adam[SECOND_DECAY_LOG], step[0])) + adam[EPSILON]
        parameters[i] = parameters[i] - rate[0] / bias_correction(adam[FIRST_DECAY_LOG], step[0]) * mean / deviation


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def update_by_adam(
    range_start: int,
    skipped: _floats, active_count: wp.array(dtype=wp.int32), width_a: int, width_b: int, width_c: int, width_d: int,
    adam: AdamNumbers,
    grad_a: _floats, step_a: _floats, rate_a: _floats, parameters_a: _floats, exp_avg_a: _floats, exp_avg_sq_a: _floats,
    grad_b: _floats, step_b: _floats, rate_b: _floats, parameters_b: _floats, exp_avg_b: _floats, exp_avg_sq_b: _floats,
    grad_c: _floats, step_c: _floats, rate_c: _floats, parameters_c: _floats, exp_avg_c: _floats, exp_avg_sq_c: _floats,
    grad_d: _floats, step_d: _floats, rate_d: _floats, parameters_d: _floats, exp_avg_d: _floats, exp_avg_sq_d: _floats,
):
    """Update every number of PARAMETERS_PER_LAUNCH parameters by Adam, in place; none if skipped[0] is not 0.

    Launched over the longest parameter. step: [1], already counted up; rate: [1]; all None for an absent
    parameter. exp_avg, exp_avg_sq: first and second moments. active_count, width_*: as of active_values().
    """
    i = range_start + wp.tid()
    if skipped[0] == 0.0:
        step_by_adam(i, active_count, width_a, adam, grad_a, step_a, rate_a, parameters_a, exp_avg_a, exp_avg_sq_a)
        step_by_adam(i, active_count, width_b, adam, grad_b, step_b, rate_b, parameters_b, exp_avg_b, exp_avg_sq_b)
        step_by_adam(i, active_count, width_c, adam, grad_c, step_c, rate_c, parameters_c, exp_avg_c, exp_avg_sq_c)
        step_by_adam(i, active_count, width_d, adam, grad_d, step_d, rate_d, parameters_d, exp_avg_d, exp_avg_sq_d)


@wp.func
def is_finite(values: _floats, index: int) -> bool:
    """Return whether a number and its square, which Adam's second moment takes, are finite; true beyond the end."""
    finite = bool(True)
    if index < values.shape[0]:
        finite = wp.isfinite(values[index] * values[index])
    return finite


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def find_nonfinite(
    range_start: int,
    a: _floats, b: _floats, c: _floats, d: _floats, e: _floats, f: _floats,
    g: _floats, h: _floats, i: _floats, j: _floats, k: _floats, m: _floats,
    result: _floats,
):
    """Set result[0] to infinity if one of the numbers is not finite. Launched over the longest."""
    n = range_start + wp.tid()
    if not (
        is_finite(a, n) and is_finite(b, n) and is_finite(c, n) and is_finite(d, n) and is_finite(e, n)
        and is_finite(f, n) and is_finite(g, n) and is_finite(h, n) and is_finite(i, n) and is_finite(j, n)
        and is_finite(k, n) and is_finite(m, n)
    ):
        result[0] = wp.inf


@wp.func
def index_in_turn(k: int, turn: int, update_interval: int) -> int:
    """Return the index of the k-th number that is updated in a turn; numbers take turns in blocks of SH_BLOCK."""
    return k + (k // wp.static(SH_BLOCK) * (update_interval - 1) + turn) * wp.static(SH_BLOCK)


@cache
def harmonics_adam_kernel(count: int):
    """Return update_by_adam() for coefficients of harmonics [3 N count] whose gradients are not stored.

    They are computed as by harmonics.coefficient_backward_kernel(). Blocks of SH_BLOCK coefficients are updated in
    `update_interval` turns. Launched over `stride` threads: a thread takes VALUES_PER_THREAD coefficients, `stride`
    apart, and requests the memory of all before it waits for any.
    """
    numbers, whole_numbers = vector(VALUES_PER_THREAD, wp.float32), vector(VALUES_PER_THREAD, wp.int32)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def update_harmonics_by_adam(
        range_start: int,
        basis: wp.array3d(dtype=wp.float32), grad_colors: wp.array3d(dtype=wp.float32), start: int, stride: int,
        update_interval: int,
        step: wp.array(dtype=wp.float32), rate: wp.array(dtype=wp.float32), skipped: wp.array(dtype=wp.float32),
        active_count: wp.array(dtype=wp.int32), adam: AdamNumbers,
        parameters: wp.array(dtype=wp.float32), first_moments: wp.array(dtype=wp.float32),
        second_moments: wp.array(dtype=wp.float32),
    ):
        thread = range_start + wp.tid()
        turn = int(step[0]) % update_interval
        final = active_values(parameters, active_count, wp.static(3 * count)) - 1
        if skipped[0] == 0.0 and index_in_turn(thread, turn, update_interval) <= final:
            owners = whole_numbers()
            orders = whole_numbers()
            channels = whole_numbers()
            gradients = numbers()
            means = numbers()
            squares = numbers()
            values = numbers()
            for k in range(wp.static(VALUES_PER_THREAD)):
                i = wp.min(index_in_turn(thread + k * stride, turn, update_interval), final)
                means[k] = first_moments[i]
                squares[k] = second_moments[i]
                values[k] = parameters[i]
                owners[k] = i // wp.static(3 * count)
                rest = i - owners[k] * wp.static(3 * count)
                orders[k] = start + rest // 3
                channels[k] = rest % 3
            basis_count = basis.shape[1]
            for view in range(basis.shape[0]):
                for k in range(wp.static(VALUES_PER_THREAD)):
                    basis_value = basis[view, wp.min(orders[k], basis_count - 1), owners[k]]
                    grad_color = grad_colors[view, owners[k], channels[k]]
                    gradients[k] += wp.where(orders[k] < basis_count, basis_value, 0.0) * grad_color
            turn_count = wp.ceil(step[0] / float(update_interval))
            length = rate[0] / bias_correction(adam[FIRST_DECAY_LOG], turn_count)
            enlarged = 1.0 / wp.sqrt(bias_correction(adam[SECOND_DECAY_LOG], turn_count))
            for k in range(wp.static(VALUES_PER_THREAD)):
                mean = means[k] + adam[FIRST_GAIN] * (gradients[k] - means[k])
                square = squares[k] + adam[SECOND_GAIN] * (gradients[k] * gradients[k] - squares[k])
                i = index_in_turn(thread + k * stride, turn, update_interval)
                if i <= final:
                    first_moments[i] = mean
                    second_moments[i] = square
                    parameters[i] = values[k] - length * mean / (wp.sqrt(square) * enlarged + adam[EPSILON])

    return update_harmonics_by_adam


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def add_gradient_statistics(
    range_start: int,
    gradients: wp.array(dtype=wp.vec2), radii: wp.array(dtype=wp.float32), usable: wp.array(dtype=wp.float32),
    half_width: float, half_height: float,
    gradient_sum: wp.array(dtype=wp.float32), photo_count: wp.array(dtype=wp.float32),
):
    """Add, for each Gaussian with a radius, the length of its gradient by the projected center, and 1.

    Lengths are in units of half the image's sides. Nothing is added if usable[0] is 0.
    """
    i = range_start + wp.tid()
    if radii[i] > 0.0 and usable[0] != 0.0:
        x = gradients[i][0] * half_width
        y = gradients[i][1] * half_height
        # As hypot: squares of small gradients must not vanish.
        larger = wp.max(wp.abs(x), wp.abs(y))
        length = float(0.0)
        if larger > 0.0:
            length = larger * wp.sqrt((x / larger) * (x / larger) + (y / larger) * (y / larger))
        gradient_sum[i] = gradient_sum[i] + length
        photo_count[i] = photo_count[i] + 1.0


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def add_position_noise(
    range_start: int,
    log_scales: wp.array(dtype=_vec3), quaternions: wp.array(dtype=_vec4),
    opacity_logits: wp.array(dtype=wp.float32),
    seed: int, strength: float, most_sizes: float, most_distance: float,
    means: wp.array(dtype=_vec3),
):
    """Add strength / max(1, |mean|) * sigmoid(100 (0.005 - opacity)) * R S S R^T * normal noise to the means.

    Each axis moves at most most_sizes of the Gaussian's standard deviations (times a normal number). Nothing moves
    farther from the origin than most_distance, unless it is there already and comes nearer. Depends on seed and index
    alone.
    """
    i = range_start + wp.tid()
    opacity = 1.0 / (1.0 + wp.exp(-opacity_logits[i]))
    above = SHARPNESS * (opacity - (1.0 - CENTER))
    if above > NOISE_CUTOFF:
        return
    faintness = 1.0 / (1.0 + wp.exp(above))
    state = wp.rand_init(seed, i)
    mean = means[i]
    distance = wp.length(mean)
    amplitude = strength * faintness / wp.max(1.0, distance)
    noise = _vec3(wp.randn(state), wp.randn(state), wp.randn(state))
    rotation = _g.rotation_from_quaternion(quaternions[i])
    along = wp.transpose(rotation) * noise
    scale = log_scales[i]
    shaped = _vec3()
    for axis in range(3):
        # Bounded as in the projection: for an opaque one the rest is 0, and 0 times infinity is no position.
        size = wp.exp(wp.clamp(scale[axis], -LOG_SCALE_MAX, LOG_SCALE_MAX))
        shaped[axis] = along[axis] * size * wp.min(amplitude * size, most_sizes)
    moved = mean + rotation * shaped
    if wp.length(moved) <= wp.max(distance, most_distance):
        means[i] = moved
