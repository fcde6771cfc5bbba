"""Adam (Kingma and Ba 2015), one thread a number.

torch's fused Adam hands each block 65536 numbers: a scene of 100,000 Gaussians then keeps 90 blocks busy on a GPU that
has room for thousands. The update only reads and writes memory, so one thread a number runs at the memory's speed.
"""

import warp as wp


@wp.func
def bias_correction(decay_log: float, step: float) -> float:
    """1 - exp(step decay_log), without the cancellation that the first steps would suffer in float32."""
    x = step * decay_log
    correction = 1.0 - wp.exp(x)
    if x > -0.02:
        correction = -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x / 24.0)))
    return correction


@wp.func
def updated(
    i: int,
    gradients: wp.array(dtype=wp.float32),
    step: float,
    scale: float,
    first_gain: float,
    second_gain: float,
    first_decay_log: float,
    second_decay_log: float,
    epsilon: float,
    parameters: wp.array(dtype=wp.float32),
    first_moments: wp.array(dtype=wp.float32),
    second_moments: wp.array(dtype=wp.float32),
):
    """One step of number i."""
    gradient = gradients[i]
    first = first_moments[i] + first_gain * (gradient - first_moments[i])
    second = second_moments[i] + second_gain * (gradient * gradient - second_moments[i])
    first_moments[i] = first
    second_moments[i] = second
    deviation = wp.sqrt(second / bias_correction(second_decay_log, step)) + epsilon
    parameters[i] = parameters[i] - scale / bias_correction(first_decay_log, step) * first / deviation


@wp.kernel(module="unique", module_options={"enable_backward": False})
def adam_update_visible(
    gradients: wp.array(dtype=wp.float32),
    step: wp.array(dtype=wp.float32),
    rate: wp.array(dtype=wp.float32),
    skipped: wp.array(dtype=wp.float32),
    visible: wp.array(dtype=wp.bool),
    row: int,
    rate_factor: float,
    first_gain: float,
    second_gain: float,
    first_decay_log: float,
    second_decay_log: float,
    epsilon: float,
    parameters: wp.array(dtype=wp.float32),
    first_moments: wp.array(dtype=wp.float32),
    second_moments: wp.array(dtype=wp.float32),
):
    """adam_update of the rows of `row` numbers that are visible: of the others neither is read or written."""
    i = wp.tid()
    if skipped[0] == 0.0 and visible[i // row]:
        updated(
            i,
            gradients,
            step[0],
            rate[0] * rate_factor,
            first_gain,
            second_gain,
            first_decay_log,
            second_decay_log,
            epsilon,
            parameters,
            first_moments,
            second_moments,
        )


@wp.kernel(module="unique", module_options={"enable_backward": False})
def adam_update(
    gradients: wp.array(dtype=wp.float32),
    step: wp.array(dtype=wp.float32),
    rate: wp.array(dtype=wp.float32),
    skipped: wp.array(dtype=wp.float32),
    rate_factor: float,
    first_gain: float,
    second_gain: float,
    first_decay_log: float,
    second_decay_log: float,
    epsilon: float,
    parameters: wp.array(dtype=wp.float32),
    first_moments: wp.array(dtype=wp.float32),
    second_moments: wp.array(dtype=wp.float32),
):
    """One step of every number; none where skipped[0] is not 0.

    step: [1], already counted up; rate: [1], times rate_factor the learning rate; *_decay_log: log of
    the decays; *_gain: 1 - decay, not as float32 would round it.
    """
    i = wp.tid()
    if skipped[0] == 0.0:
        updated(
            i,
            gradients,
            step[0],
            rate[0] * rate_factor,
            first_gain,
            second_gain,
            first_decay_log,
            second_decay_log,
            epsilon,
            parameters,
            first_moments,
            second_moments,
        )


@wp.kernel(module="unique", module_options={"enable_backward": False})
def judge_step(
    loss: wp.array(dtype=wp.float32),
    norms: wp.array(dtype=wp.float32),
    incomplete: wp.array(dtype=wp.bool),
    verdict: wp.array(dtype=wp.float32),
):
    """verdict: [3], 1 or 0 each: the loss or a gradient is not finite; the step is to be skipped; it is not to be.

    norms: [K] of the gradients; incomplete: [1], or [0] where nothing can be. One thread.
    """
    finite = wp.isfinite(loss[0])
    for i in range(norms.shape[0]):
        finite = finite and wp.isfinite(norms[i])
    skipped = not finite
    if incomplete.shape[0] > 0:
        skipped = skipped or incomplete[0]
    verdict[0] = wp.where(finite, 0.0, 1.0)
    verdict[1] = wp.where(skipped, 1.0, 0.0)
    verdict[2] = wp.where(skipped, 0.0, 1.0)
