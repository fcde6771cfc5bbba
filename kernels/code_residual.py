"""A simulated image beside a photo's codes: by the mu-law where light is compared, and as far as the photo can tell."""

from functools import cache

import warp as wp

from .constants import NO_AUTODIFF
from .geometry import vector


@cache
def code_residual_kernel(dtype, code, mu_law: bool):
    """Return the kernel for one scalar type and one type of codes, wp.uint8 or wp.uint16.

    mu_law: compare per_log * log(1 + mu_over_white * image) in place of the image.
    """
    real = dtype
    vec3 = vector(3, dtype)

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

    @wp.kernel(module="unique", module_options=NO_AUTODIFF | {"fuse_fp": False})
    def code_residual(
        range_start: int,
        image: wp.array(dtype=real), codes: wp.array2d(dtype=code), index: wp.array(dtype=wp.int64),
        table: wp.array(dtype=vec3), mu_over_white: real, per_log: real,
        prediction: wp.array(dtype=real), slopes: wp.array(dtype=real), target: wp.array(dtype=real),
    ):
        """Compare an image with photo index[0] of a stack of codes.

        table: value of each code, and the ends of the interval of values that map to it. Values are exposures in the
        mu-law, or encoded values. target: values of the photo. prediction: the target plus the image's distance from
        the interval. slopes: derivatives of the prediction with respect to the image.
        """
        i = range_start + wp.tid()
        row = table[int(codes[wp.int32(index[0]), i])]
        value = image[i]
        slope = real(1.0)
        if wp.static(mu_law):
            x = value * mu_over_white
            value = per_log * log1p(x)
            slope = per_log * mu_over_white / (real(1.0) + x)
        # NaN takes no branch and stays. So do values beside a code that stands for one value.
        if row[1] < row[2]:
            if value < row[1]:
                value = row[0] + (value - row[1])
            elif value > row[2]:
                value = row[0] + (value - row[2])
            elif value >= row[1]:
                value = row[0]
                slope = real(0.0)
        prediction[i] = value
        slopes[i] = slope
        target[i] = row[0]

    return code_residual
