"""Real spherical harmonics up to degree 3 as functions of the view direction, with 3DGS's basis and signs.

One thread evaluates the three channels of one Gaussian for the direction from the camera to its centre. The
coefficients come in two arrays, the constant term and the rest, because optimisers treat them at different rates.
"""

from functools import cache

import warp as wp

from .geometry import geometry


@cache
def _inverse_length(dtype):
    """A function: 1 / length of an offset, and 0 at the camera, where there is no direction."""
    g = geometry(dtype)
    real, vec3 = g.real, g.vec3

    @wp.func
    def inverse_length_of(offset: vec3) -> real:
        square = wp.dot(offset, offset)
        result = real(0.0)
        if square > real(1.0e-30):
            result = real(1.0) / wp.sqrt(square)
        return result

    return inverse_length_of


@cache
def harmonics_kernel(dtype, degree: int):
    """values[i] = sum over l <= degree and m of coefficient[i, l, m] * Y_l^m(direction), three channels at once.

    constant: [N, 1] vec3, the coefficient of Y_0; rest: [N, at least (degree + 1)^2 - 1] vec3.
    """
    g = geometry(dtype)
    real, vec3 = g.real, g.vec3
    inverse_length_of = _inverse_length(dtype)

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def evaluate_harmonics(
        first: int,
        constant: wp.array2d(dtype=vec3), rest: wp.array2d(dtype=vec3), means: wp.array(dtype=vec3),
        camera_position: wp.array(dtype=vec3), values: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        value = real(0.28209479177387814) * constant[i, 0]
        if wp.static(degree > 0):
            offset = means[i] - camera_position[0]
            d = offset * inverse_length_of(offset)
            x = d[0]
            y = d[1]
            z = d[2]
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


@cache
def harmonics_adjoint_kernel(dtype, degree: int):
    """The adjoint of harmonics_kernel by coefficients and centres, written rather than added to.

    value_gradients, mean_gradients: [N] vec3; constant_gradients, rest_gradients: as the coefficients; those of higher
    degrees are set to 0. By the camera's position the gradient is the sum of mean_gradients, negated.
    """
    g = geometry(dtype)
    real, vec3 = g.real, g.vec3
    inverse_length_of = _inverse_length(dtype)

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def harmonics_adjoint(
        first: int,
        rest: wp.array2d(dtype=vec3), means: wp.array(dtype=vec3), camera_position: wp.array(dtype=vec3),
        value_gradients: wp.array(dtype=vec3), constant_gradients: wp.array2d(dtype=vec3),
        rest_gradients: wp.array2d(dtype=vec3), mean_gradients: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        gradient = value_gradients[i]
        constant_gradients[i, 0] = real(0.28209479177387814) * gradient
        by_mean = vec3()
        if wp.static(degree > 0):
            offset = means[i] - camera_position[0]
            inverse_length = inverse_length_of(offset)
            d = offset * inverse_length
            x = d[0]
            y = d[1]
            z = d[2]
            c1 = real(0.4886025119029199)
            rest_gradients[i, 0] = (-c1 * y) * gradient
            rest_gradients[i, 1] = (c1 * z) * gradient
            rest_gradients[i, 2] = (-c1 * x) * gradient
            by_direction = c1 * vec3(
                -wp.dot(rest[i, 2], gradient), -wp.dot(rest[i, 0], gradient), wp.dot(rest[i, 1], gradient)
            )
            if wp.static(degree > 1):
                a = real(1.0925484305920792)
                b = real(0.31539156525252005)
                c = real(0.5462742152960396)
                xx = x * x
                yy = y * y
                zz = z * z
                rest_gradients[i, 3] = (a * x * y) * gradient
                rest_gradients[i, 4] = (-a * y * z) * gradient
                rest_gradients[i, 5] = (b * (real(2.0) * zz - xx - yy)) * gradient
                rest_gradients[i, 6] = (-a * x * z) * gradient
                rest_gradients[i, 7] = (c * (xx - yy)) * gradient
                by_direction += (a * wp.dot(rest[i, 3], gradient)) * vec3(y, x, real(0.0))
                by_direction += (-a * wp.dot(rest[i, 4], gradient)) * vec3(real(0.0), z, y)
                by_direction += (real(2.0) * b * wp.dot(rest[i, 5], gradient)) * vec3(-x, -y, real(2.0) * z)
                by_direction += (-a * wp.dot(rest[i, 6], gradient)) * vec3(z, real(0.0), x)
                by_direction += (real(2.0) * c * wp.dot(rest[i, 7], gradient)) * vec3(x, -y, real(0.0))
                if wp.static(degree > 2):
                    e = real(-0.5900435899266435)
                    f = real(2.890611442640554)
                    h = real(-0.4570457994644658)
                    m = real(0.3731763325901154)
                    n = real(1.445305721320277)
                    three = real(3.0)
                    xy = x * y
                    xz = x * z
                    yz = y * z
                    rest_gradients[i, 8] = (e * y * (three * xx - yy)) * gradient
                    rest_gradients[i, 9] = (f * xy * z) * gradient
                    rest_gradients[i, 10] = (h * y * (real(4.0) * zz - xx - yy)) * gradient
                    rest_gradients[i, 11] = (m * z * (real(2.0) * zz - three * xx - three * yy)) * gradient
                    rest_gradients[i, 12] = (h * x * (real(4.0) * zz - xx - yy)) * gradient
                    rest_gradients[i, 13] = (n * z * (xx - yy)) * gradient
                    rest_gradients[i, 14] = (e * x * (xx - three * yy)) * gradient
                    by_direction += (three * e * wp.dot(rest[i, 8], gradient)) * vec3(
                        real(2.0) * xy, xx - yy, real(0.0)
                    )
                    by_direction += (f * wp.dot(rest[i, 9], gradient)) * vec3(yz, xz, xy)
                    by_direction += (h * wp.dot(rest[i, 10], gradient)) * vec3(
                        real(-2.0) * xy, real(4.0) * zz - xx - three * yy, real(8.0) * yz
                    )
                    by_direction += (three * m * wp.dot(rest[i, 11], gradient)) * vec3(
                        real(-2.0) * xz, real(-2.0) * yz, real(2.0) * zz - xx - yy
                    )
                    by_direction += (h * wp.dot(rest[i, 12], gradient)) * vec3(
                        real(4.0) * zz - three * xx - yy, real(-2.0) * xy, real(8.0) * xz
                    )
                    by_direction += (n * wp.dot(rest[i, 13], gradient)) * vec3(real(2.0) * xz, real(-2.0) * yz, xx - yy)
                    by_direction += (three * e * wp.dot(rest[i, 14], gradient)) * vec3(
                        xx - yy, real(-2.0) * xy, real(0.0)
                    )
            # Only what turns the direction counts: along it the harmonics do not change.
            by_mean = (by_direction - d * wp.dot(d, by_direction)) * inverse_length
        for unused in range(wp.static((degree + 1) * (degree + 1) - 1), rest_gradients.shape[1]):
            rest_gradients[i, unused] = vec3()
        mean_gradients[i] = by_mean

    return harmonics_adjoint
