"""What a training does at every step beside rendering, each in one launch: torch would make a dozen of it.

Adam (Kingma and Ba 2015) takes one thread a number. torch's fused Adam hands each block 65536 numbers: a scene of
100,000 Gaussians then keeps 90 blocks busy on a GPU that has room for thousands.
"""

from functools import cache

import warp as wp

from .constants import LOG_SCALE_MAX
from .geometry import geometry, vector
from .harmonics import coefficient_gradient

SHARPNESS, CENTRE = 100.0, 0.995  # 3DGS-MCMC, equation 8: noise is for Gaussians of opacity below 1 - 0.995
NOTHING = 16.0  # The exponent from which on a Gaussian's noise is a ten-millionth, and is not drawn

_g = geometry(wp.float32)
_vec3, _vec4 = vector(3, wp.float32), vector(4, wp.float32)


@wp.kernel(module="unique", module_options={"enable_backward": False})
def judge_step(
    loss: wp.array(dtype=wp.float32), norms: wp.array(dtype=wp.float32), incomplete: wp.array(dtype=wp.bool),
    verdict: wp.array(dtype=wp.float32),
):
    """verdict: [3], 1 or 0 each: the loss or a gradient is not finite; the step is to be skipped; it is not to be.
    norms: [K] of the gradients; incomplete: [1], or [0] where nothing can be. One thread."""
    finite = wp.isfinite(loss[0])
    for i in range(norms.shape[0]):
        finite = finite and wp.isfinite(norms[i])
    skipped = not finite
    if incomplete.shape[0] > 0:
        skipped = skipped or incomplete[0]
    verdict[0] = wp.where(finite, 0.0, 1.0)
    verdict[1] = wp.where(skipped, 1.0, 0.0)
    verdict[2] = wp.where(skipped, 0.0, 1.0)


@wp.func
def bias_correction(decay_log: float, step: float) -> float:
    """1 - exp(step decay_log), without the cancellation that the first steps would suffer in float32."""
    x = step * decay_log
    correction = 1.0 - wp.exp(x)
    if x > -0.02:
        correction = -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x / 24.0)))
    return correction


@wp.func
def step_by_adam(
    i: int, gradient: float, step: float, rate: float,
    first_gain: float, second_gain: float, first_decay_log: float, second_decay_log: float, epsilon: float,
    parameters: wp.array(dtype=wp.float32), first_moments: wp.array(dtype=wp.float32),
    second_moments: wp.array(dtype=wp.float32),
):
    """One step of number i, in place."""
    mean = first_moments[i] + first_gain * (gradient - first_moments[i])
    square = second_moments[i] + second_gain * (gradient * gradient - second_moments[i])
    first_moments[i] = mean
    second_moments[i] = square
    deviation = wp.sqrt(square / bias_correction(second_decay_log, step)) + epsilon
    parameters[i] = parameters[i] - rate / bias_correction(first_decay_log, step) * mean / deviation


@wp.kernel(module="unique", module_options={"enable_backward": False})
def update_by_adam(
    first: int,
    gradients: wp.array(dtype=wp.float32), step: wp.array(dtype=wp.float32), rate: wp.array(dtype=wp.float32),
    skipped: wp.array(dtype=wp.float32),
    first_gain: float, second_gain: float, first_decay_log: float, second_decay_log: float, epsilon: float,
    parameters: wp.array(dtype=wp.float32), first_moments: wp.array(dtype=wp.float32),
    second_moments: wp.array(dtype=wp.float32),
):
    """One step of every number, in place; none where skipped[0] is not 0. step: [1], already counted up; rate: [1];
    *_decay_log: log of the decays; *_gain: 1 - decay, not as float32 would round it."""
    i = first + wp.tid()
    if skipped[0] == 0.0:
        step_by_adam(
            i, gradients[i], step[0], rate[0], first_gain, second_gain, first_decay_log, second_decay_log, epsilon,
            parameters, first_moments, second_moments,
        )  # fmt: skip


@cache
def harmonics_adam_kernel(count: int):
    """update_by_adam of coefficients of harmonics, [3 N count], whose gradients nobody stored: they are as
    coefficient_gradient() multiplies them out."""
    gradient_of = coefficient_gradient(wp.float32, count)

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def update_harmonics_by_adam(
        first: int,
        basis: wp.array3d(dtype=wp.float32), value_gradients: wp.array3d(dtype=wp.float32), start: int,
        step: wp.array(dtype=wp.float32), rate: wp.array(dtype=wp.float32), skipped: wp.array(dtype=wp.float32),
        first_gain: float, second_gain: float, first_decay_log: float, second_decay_log: float, epsilon: float,
        parameters: wp.array(dtype=wp.float32), first_moments: wp.array(dtype=wp.float32),
        second_moments: wp.array(dtype=wp.float32),
    ):
        i = first + wp.tid()
        if skipped[0] == 0.0:
            gradient = gradient_of(i, start, basis, value_gradients)
            step_by_adam(
                i, gradient, step[0], rate[0], first_gain, second_gain, first_decay_log, second_decay_log, epsilon,
                parameters, first_moments, second_moments,
            )  # fmt: skip

    return update_harmonics_by_adam


@wp.kernel(module="unique", module_options={"enable_backward": False})
def add_gradient_statistics(
    first: int,
    gradients: wp.array(dtype=wp.vec2), radii: wp.array(dtype=wp.float32), usable: wp.array(dtype=wp.float32),
    half_width: float, half_height: float,
    gradient_sum: wp.array(dtype=wp.float32), seen: wp.array(dtype=wp.float32),
):
    """Adds the lengths of the gradients by the projected centres, in units of half the image's sides, and 1, for each
    Gaussian with a radius; nothing where usable[0] is 0."""
    i = first + wp.tid()
    if radii[i] > 0.0 and usable[0] != 0.0:
        x = gradients[i][0] * half_width
        y = gradients[i][1] * half_height
        # As hypot: squares of small gradients must not vanish.
        larger = wp.max(wp.abs(x), wp.abs(y))
        length = float(0.0)
        if larger > 0.0:
            length = larger * wp.sqrt((x / larger) * (x / larger) + (y / larger) * (y / larger))
        gradient_sum[i] = gradient_sum[i] + length
        seen[i] = seen[i] + 1.0


@wp.kernel(module="unique", module_options={"enable_backward": False})
def add_position_noise(
    first: int,
    log_scales: wp.array(dtype=_vec3), quaternions: wp.array(dtype=_vec4),
    opacity_logits: wp.array(dtype=wp.float32),
    seed: int, strength: float,
    means: wp.array(dtype=_vec3),
):
    """means += strength * sigmoid(100 (0.005 - opacity)) * R S S R^T * normal noise, of seed and index alone."""
    i = first + wp.tid()
    opacity = 1.0 / (1.0 + wp.exp(-opacity_logits[i]))
    above = SHARPNESS * (opacity - (1.0 - CENTRE))
    if above > NOTHING:
        return
    faintness = 1.0 / (1.0 + wp.exp(above))
    state = wp.rand_init(seed, i)
    noise = _vec3(wp.randn(state), wp.randn(state), wp.randn(state)) * (strength * faintness)
    rotation = _g.rotation_from_quaternion(quaternions[i])
    along = wp.transpose(rotation) * noise
    scale = log_scales[i]
    shaped = _vec3()
    for axis in range(3):
        # Bounded as in the projection: for an opaque one the rest is 0, and 0 times infinity is no position.
        shaped[axis] = along[axis] * wp.exp(2.0 * wp.clamp(scale[axis], -LOG_SCALE_MAX, LOG_SCALE_MAX))
    means[i] = means[i] + rotation * shaped
