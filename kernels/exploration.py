"""Noise on the positions of faint Gaussians, by which relocation explores (3DGS-MCMC, NeurIPS 2024, equation 8).

Torch would make some twenty launches of it in every step.
"""

import warp as wp

from .constants import LOG_SCALE_MAX
from .geometry import geometry, vector

SHARPNESS, CENTRE = 100.0, 0.995
"""Equation 8: noise is for Gaussians of opacity below 1 - 0.995."""

_g = geometry(wp.float32)
_vec3, _vec4 = vector(3, wp.float32), vector(4, wp.float32)


@wp.kernel(module="unique", module_options={"enable_backward": False})
def explore(
    first: int,
    log_scales: wp.array(dtype=_vec3),
    quaternions: wp.array(dtype=_vec4),
    opacity_logits: wp.array(dtype=wp.float32),
    seed: int,
    strength: float,
    means: wp.array(dtype=_vec3),
):
    """means += strength * sigmoid(100 (0.005 - opacity)) * R S S R^T * normal noise, of seed and index alone."""
    i = first + wp.tid()
    opacity = 1.0 / (1.0 + wp.exp(-opacity_logits[i]))
    faintness = 1.0 / (1.0 + wp.exp(-SHARPNESS * (1.0 - opacity - CENTRE)))
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
