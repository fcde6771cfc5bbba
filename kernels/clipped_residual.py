"""A simulated image beside a photo's codes: by the mu-law where light is compared, and as far as the photo can tell."""

from functools import cache

import warp as wp

from .constants import FORWARD


@cache
def clipped_residual_kernel(dtype, code, mu_law: bool):
    """The kernel for one scalar type and one type of codes, wp.uint8 or wp.uint16.

    mu_law: the image becomes gain log(1 + scale x); otherwise it is compared as it is.
    """
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

    @wp.kernel(module="unique", module_options=FORWARD | {"fuse_fp": False})
    def clipped_residual(
        first: int,
        image: wp.array(dtype=real), codes: wp.array2d(dtype=code), index: wp.array(dtype=wp.int64),
        table: wp.array(dtype=real),
        scale: real, gain: real, white: int, black: int, below_white: real, above_black: real,
        seen: wp.array(dtype=real), slopes: wp.array(dtype=real), truth: wp.array(dtype=real),
    ):
        """truth: what the table holds for the codes of photo index[0]. seen: of the image; where the code is `white`
        the truth, less what is missing to truth - below_white; where it is `black` the truth, plus what is beyond
        truth + above_black. slopes: the derivatives of seen by image."""
        i = first + wp.tid()
        found = int(codes[wp.int32(index[0]), i])
        goal = table[found]
        value = image[i]
        slope = real(1.0)
        if wp.static(mu_law):
            x = value * scale
            value = gain * log1p(x)
            slope = gain * scale / (real(1.0) + x)
        if found == white:
            missing = value - (goal - below_white)
            value = goal + wp.min(missing, real(0.0))
            if missing > real(0.0):
                slope = real(0.0)
        elif found == black:
            beyond = value - (goal + above_black)
            value = goal + wp.max(beyond, real(0.0))
            if beyond < real(0.0):
                slope = real(0.0)
        seen[i] = value
        slopes[i] = slope
        truth[i] = goal

    return clipped_residual
