"""Real spherical harmonics up to degree 3 as functions of the view direction, with 3DGS's basis and signs.

One thread evaluates the three channels of one Gaussian for the direction from the camera to its centre. The
coefficients come in two arrays, the constant term and the rest, because optimisers treat them at different rates.
"""

from functools import cache

import warp as wp

from .geometry import geometry


@cache
def harmonics_kernel(dtype, degree: int):
    """values[i] = sum over l <= degree and m of coefficient[i, l, m] * Y_l^m(direction), three channels at once.

    constant: [N, 1] vec3, the coefficient of Y_0; rest: [N, at least (degree + 1)^2 - 1] vec3.
    """
    g = geometry(dtype)
    real, vec3 = g.real, g.vec3

    @wp.kernel(module="unique", module_options={"enable_backward": True})
    def evaluate_harmonics(
        first: int,
        constant: wp.array2d(dtype=vec3),
        rest: wp.array2d(dtype=vec3),
        means: wp.array(dtype=vec3),
        camera_position: wp.array(dtype=vec3),
        values: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        value = real(0.28209479177387814) * constant[i, 0]
        if wp.static(degree > 0):
            offset = means[i] - camera_position[0]
            square = wp.dot(offset, offset)
            away = square > real(1.0e-30)
            # At the camera there is no direction; sqrt's infinite derivative at 0 must not be met there.
            inverse_length = wp.where(away, real(1.0) / wp.sqrt(wp.where(away, square, real(1.0))), real(0.0))
            x = offset[0] * inverse_length
            y = offset[1] * inverse_length
            z = offset[2] * inverse_length
            c1 = real(0.4886025119029199)
            value += (-c1 * y) * rest[i, 0] + (c1 * z) * rest[i, 1] + (-c1 * x) * rest[i, 2]
            if wp.static(degree > 1):
                xx = x * x
                yy = y * y
                zz = z * z
                value += (real(1.0925484305920792) * x * y) * rest[i, 3]
                value += (real(-1.0925484305920792) * y * z) * rest[i, 4]
                value += (real(0.31539156525252005) * (real(2.0) * zz - xx - yy)) * rest[i, 5]
                value += (real(-1.0925484305920792) * x * z) * rest[i, 6]
                value += (real(0.5462742152960396) * (xx - yy)) * rest[i, 7]
                if wp.static(degree > 2):
                    value += (real(-0.5900435899266435) * y * (real(3.0) * xx - yy)) * rest[i, 8]
                    value += (real(2.890611442640554) * x * y * z) * rest[i, 9]
                    value += (real(-0.4570457994644658) * y * (real(4.0) * zz - xx - yy)) * rest[i, 10]
                    value += (
                        real(0.3731763325901154) * z * (real(2.0) * zz - real(3.0) * xx - real(3.0) * yy)
                    ) * rest[i, 11]
                    value += (real(-0.4570457994644658) * x * (real(4.0) * zz - xx - yy)) * rest[i, 12]
                    value += (real(1.445305721320277) * z * (xx - yy)) * rest[i, 13]
                    value += (real(-0.5900435899266435) * x * (xx - real(3.0) * yy)) * rest[i, 14]
        values[i] = value

    return evaluate_harmonics
