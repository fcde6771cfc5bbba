"""Exposures as a training compares them: by the mu-law, and where the camera saturated as far as its photo can tell."""

from functools import cache

import warp as wp


@cache
def one_sided_kernel(dtype):
    """seen_by_photo for one scalar type."""
    real = dtype

    @wp.func
    def log1p(x: real) -> real:
        """Kahan's: 1 + x loses digits of a small x, and the quotient gives them back. x > -1."""
        u = real(1.0) + x
        result = x
        if u != real(1.0):
            result = wp.log(u)
            if wp.isfinite(u):
                result *= x / (u - real(1.0))
        return result

    @wp.kernel(module="unique", module_options={"enable_backward": False, "fuse_fp": False})
    def seen_by_photo(
        light: wp.array(dtype=real),
        photo_light: wp.array(dtype=real),
        clipped: wp.array(dtype=wp.bool),
        black: wp.array(dtype=wp.bool),
        scale: real,
        gain: real,
        below_white: real,
        above_black: real,
        seen: wp.array(dtype=real),
        slopes: wp.array(dtype=real),
        truth: wp.array(dtype=real),
    ):
        """The mu-law is gain log(1 + scale x). seen: of light; at a clipped number of the photo its truth, less what is
        missing to truth - below_white; at a black one its truth, plus what is beyond truth + above_black. slopes: the
        derivatives of seen by light; truth: of photo_light. clipped, black: [0] where the photo has none."""
        i = wp.tid()
        x = light[i] * scale
        value = gain * log1p(x)
        slope = gain * scale / (real(1.0) + x)
        goal = gain * log1p(photo_light[i] * scale)
        result = value
        if clipped.shape[0] > 0 and clipped[i]:
            missing = value - (goal - below_white)
            result = goal + wp.min(missing, real(0.0))
            if missing > real(0.0):
                slope = real(0.0)
        elif black.shape[0] > 0 and black[i]:
            beyond = value - (goal + above_black)
            result = goal + wp.max(beyond, real(0.0))
            if beyond < real(0.0):
                slope = real(0.0)
        seen[i] = result
        slopes[i] = slope
        truth[i] = goal

    return seen_by_photo
