"""Camera responses that have a formula, with their derivative: a tone curve, then a power law with a linear toe."""

from functools import cache

import warp as wp

from .constants import NO_AUTODIFF
from .geometry import vector

NO_TONE, REINHARD, FILMIC, KNEE = 0, 1, 2, 3


@cache
def encode_kernel(dtype, tone: int):
    """Return encode() for one scalar type and one tone curve: NO_TONE, REINHARD, FILMIC or KNEE."""
    real = dtype
    vec4, vec5 = vector(4, dtype), vector(5, dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def encode(
        range_start: int,
        exposures: wp.array(dtype=real),
        power_law: vec4, tone_numbers: vec5, clip: real, extension_slope: real,
        values: wp.array(dtype=real), slopes: wp.array(dtype=real),
    ):
        """Encode exposures by a tone curve and a power law, with derivatives.

        power_law: exponent, offset, slope and end of the toe. tone_numbers: Filmic's a, b, d, e, g or Knee's start and
        softness. clip: clip point, infinite for none. extension_slope: slope by log exposure beyond it.
        """
        i = range_start + wp.tid()
        exposure = exposures[i]
        x = wp.clamp(exposure, real(0.0), clip)
        light = x
        light_slope = real(1.0)
        if wp.static(tone == REINHARD):
            # As 1 / (1 + 1/x): exact at both ends, also for x = 0 and infinity.
            light = real(1.0) / (real(1.0) + real(1.0) / x)
            light_slope = real(1.0) / ((real(1.0) + x) * (real(1.0) + x))
        if wp.static(tone == FILMIC):
            below = x * (tone_numbers[2] * x + tone_numbers[3]) + tone_numbers[4]
            light = x * (tone_numbers[0] * x + tone_numbers[1]) / below
            rise = real(2.0) * tone_numbers[0] * x + tone_numbers[1]
            light_slope = (rise - light * (real(2.0) * tone_numbers[2] * x + tone_numbers[3])) / below
        if wp.static(tone == KNEE):
            beyond = wp.max(x - tone_numbers[0], real(0.0)) / tone_numbers[1]
            light = wp.min(x, tone_numbers[0]) + tone_numbers[1] * wp.log(real(1.0) + beyond)
            light_slope = real(1.0) / (real(1.0) + beyond)
        if wp.static(tone != NO_TONE):
            light = wp.clamp(light, real(0.0), real(1.0))
        value = power_law[2] * light
        slope = power_law[2]
        if not (light < power_law[3]) and power_law[3] < real(1.0):
            power = wp.pow(light, real(1.0) / power_law[0]) * (real(1.0) + power_law[1])
            value = wp.min(power - power_law[1], real(1.0))
            slope = power / (power_law[0] * light)
        slope *= light_slope
        if exposure > clip:
            if extension_slope > real(0.0):
                value += extension_slope * wp.log(exposure / clip)
            slope = extension_slope / exposure
        if exposure < real(0.0):
            slope = real(0.0)
        values[i] = wp.where(wp.isnan(exposure), exposure, value)
        slopes[i] = wp.where(wp.isnan(exposure), exposure, slope)

    return encode
