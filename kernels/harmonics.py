"""Real spherical harmonics up to degree 3 as functions of the view direction, with 3DGS's basis and signs.

One thread evaluates the three channels of one Gaussian for the direction from the camera to its center. The
coefficients come in two arrays, the constant term and the rest, because optimizers treat them at different rates.
They are numbered k = l^2 + l + m from 0 on, of which the constant term is the first.
"""

from functools import cache

import warp as wp

from .constants import NO_AUTODIFF
from .geometry import geometry, vector


@cache
def harmonic_functions(dtype):
    """Return two functions: direction_of() and harmonic(), which is Y_k(x, y, z) of a unit direction.

    direction_of() returns the unit direction from a camera to a point and the inverse of their distance. All four are 0
    if the two coincide or if the distance is not finite.
    """
    g = geometry(dtype)
    real, vec3, vec4 = g.real, g.vec3, g.vec4

    @wp.func
    def direction_of(point: vec3, camera: vec3) -> vec4:
        offset = point - camera
        square = wp.dot(offset, offset)
        direction = vec4()
        if square > real(1.0e-30) and wp.isfinite(square):
            inverse = real(1.0) / wp.sqrt(square)
            direction = vec4(offset[0] * inverse, offset[1] * inverse, offset[2] * inverse, inverse)
        return direction

    @wp.func
    def harmonic(k: int, x: real, y: real, z: real) -> real:
        xx = x * x
        yy = y * y
        zz = z * z
        value = real(0.28209479177387814)
        if k == 1:
            value = real(-0.4886025119029199) * y
        elif k == 2:
            value = real(0.4886025119029199) * z
        elif k == 3:
            value = real(-0.4886025119029199) * x
        elif k == 4:
            value = real(1.0925484305920792) * x * y
        elif k == 5:
            value = real(-1.0925484305920792) * y * z
        elif k == 6:
            value = real(0.31539156525252005) * (real(2.0) * zz - xx - yy)
        elif k == 7:
            value = real(-1.0925484305920792) * x * z
        elif k == 8:
            value = real(0.5462742152960396) * (xx - yy)
        elif k == 9:
            value = real(-0.5900435899266435) * y * (real(3.0) * xx - yy)
        elif k == 10:
            value = real(2.890611442640554) * x * y * z
        elif k == 11:
            value = real(-0.4570457994644658) * y * (real(4.0) * zz - xx - yy)
        elif k == 12:
            value = real(0.3731763325901154) * z * (real(2.0) * zz - real(3.0) * xx - real(3.0) * yy)
        elif k == 13:
            value = real(-0.4570457994644658) * x * (real(4.0) * zz - xx - yy)
        elif k == 14:
            value = real(1.445305721320277) * z * (xx - yy)
        elif k == 15:
            value = real(-0.5900435899266435) * x * (xx - real(3.0) * yy)
        return value

    return direction_of, harmonic


@cache
def mean_gradient_function(dtype, degree: int):
    """Return mean_gradient() and the vector type of its weights.

    mean_gradient() is the gradient, with respect to a mean, of the sum of weights times harmonics; weights[0] belongs
    to harmonic number 1. Its `direction` is direction_of() the mean.
    """
    g = geometry(dtype)
    real, vec3, vec4 = g.real, g.vec3, g.vec4
    weight_vector = vector(max((degree + 1) * (degree + 1) - 1, 1), dtype)

    @wp.func
    def mean_gradient(weights: weight_vector, direction: vec4) -> vec3:
        x = direction[0]
        y = direction[1]
        z = direction[2]
        grad_direction = vec3()
        if wp.static(degree > 0):
            c1 = real(0.4886025119029199)
            grad_direction = c1 * vec3(-weights[2], -weights[0], weights[1])
        xx = x * x
        yy = y * y
        zz = z * z
        if wp.static(degree > 1):
            a = real(1.0925484305920792)
            b = real(0.31539156525252005)
            c = real(0.5462742152960396)
            grad_direction += (a * weights[3]) * vec3(y, x, real(0.0))
            grad_direction += (-a * weights[4]) * vec3(real(0.0), z, y)
            grad_direction += (real(2.0) * b * weights[5]) * vec3(-x, -y, real(2.0) * z)
            grad_direction += (-a * weights[6]) * vec3(z, real(0.0), x)
            grad_direction += (real(2.0) * c * weights[7]) * vec3(x, -y, real(0.0))
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
            grad_direction += (three * e * weights[8]) * vec3(real(2.0) * xy, xx - yy, real(0.0))
            grad_direction += (f * weights[9]) * vec3(yz, xz, xy)
            grad_direction += (h * weights[10]) * vec3(
                real(-2.0) * xy, real(4.0) * zz - xx - three * yy, real(8.0) * yz
            )
            grad_direction += (three * m * weights[11]) * vec3(
                real(-2.0) * xz, real(-2.0) * yz, real(2.0) * zz - xx - yy
            )
            grad_direction += (h * weights[12]) * vec3(
                real(4.0) * zz - three * xx - yy, real(-2.0) * xy, real(8.0) * xz
            )
            grad_direction += (n * weights[13]) * vec3(real(2.0) * xz, real(-2.0) * yz, xx - yy)
            grad_direction += (three * e * weights[14]) * vec3(xx - yy, real(-2.0) * xy, real(0.0))
        if wp.static(degree > 0):
            # Only the part across the direction counts: along it the harmonics do not change.
            d = vec3(x, y, z)
            grad_direction = (grad_direction - d * wp.dot(d, grad_direction)) * direction[3]
        return grad_direction

    return mean_gradient, weight_vector


@cache
def harmonics_kernel(dtype, degree: int):
    """Return the kernel of values[i] = sum of coefficient[i, k] * Y_k(direction) over all k of degrees up to `degree`.

    One thread sums the three channels of a Gaussian. constant: [N, 1] vec3, the coefficient of Y_0; rest: [N, at least
    (degree + 1)^2 - 1] vec3.
    """
    vec3 = geometry(dtype).vec3
    direction_of, harmonic = harmonic_functions(dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def evaluate_harmonics(
        range_start: int,
        constant: wp.array2d(dtype=vec3), rest: wp.array2d(dtype=vec3), means: wp.array(dtype=vec3),
        camera_position: wp.array(dtype=vec3), values: wp.array(dtype=vec3),
    ):
        i = range_start + wp.tid()
        d = direction_of(means[i], camera_position[0])
        value = harmonic(0, d[0], d[1], d[2]) * constant[i, 0]
        for k in range(wp.static((degree + 1) * (degree + 1) - 1)):
            value += harmonic(k + 1, d[0], d[1], d[2]) * rest[i, k]
        values[i] = value

    return evaluate_harmonics


@cache
def channels_kernel(dtype, degree: int, with_jacobian: bool):
    """Return harmonics_kernel() with one thread for each channel, so that reads coalesce on a GPU.

    constant, rest: [N, ..., 3], values: [N, 3]. mean_jacobian, if `with_jacobian`: [N, 3] vec3, the
    gradient of each channel's value with respect to the mean. Launched over 3 N threads.
    """
    vec3 = geometry(dtype).vec3
    direction_of, harmonic = harmonic_functions(dtype)
    mean_gradient, weight_vector = mean_gradient_function(dtype, degree)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def evaluate_channels(
        range_start: int,
        constant: wp.array3d(dtype=dtype), rest: wp.array3d(dtype=dtype), means: wp.array(dtype=vec3),
        camera_position: wp.array(dtype=vec3), values: wp.array2d(dtype=dtype), mean_jacobian: wp.array2d(dtype=vec3),
    ):
        index = range_start + wp.tid()
        i = index // 3
        channel = index - 3 * i
        d = direction_of(means[i], camera_position[0])
        value = harmonic(0, d[0], d[1], d[2]) * constant[i, 0, channel]
        weights = weight_vector()
        for k in range(wp.static((degree + 1) * (degree + 1) - 1)):
            weights[k] = rest[i, k, channel]
            value += harmonic(k + 1, d[0], d[1], d[2]) * weights[k]
        if wp.static(with_jacobian):
            mean_jacobian[i, channel] = mean_gradient(weights, d)
        values[i, channel] = value

    return evaluate_channels


@cache
def zero_if_unused(dtype):
    """Return a function that drops gradients that are not finite of a Gaussian whose values nothing used.

    0 times a NaN or infinite coefficient is NaN, and the camera's gradient sums over all Gaussians.
    """
    g = geometry(dtype)
    real, vec3 = g.real, g.vec3

    @wp.func
    def without_nan(grad_mean: vec3, gradient: vec3) -> vec3:
        result = grad_mean
        if gradient[0] == real(0.0) and gradient[1] == real(0.0) and gradient[2] == real(0.0):
            if not wp.isfinite(grad_mean):
                result = vec3()
        return result

    return without_nan


@cache
def jacobian_backward_kernel(dtype):
    """Return the kernel of grad_means[i] = sum over c of grad_colors[i, c] * jacobian[i, c], over N threads."""
    vec3 = geometry(dtype).vec3
    without_nan = zero_if_unused(dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def jacobian_backward(
        range_start: int,
        jacobian: wp.array2d(dtype=vec3), grad_colors: wp.array(dtype=vec3), grad_means: wp.array(dtype=vec3),
    ):
        i = range_start + wp.tid()
        gradient = grad_colors[i]
        grad_mean = gradient[0] * jacobian[i, 0] + gradient[1] * jacobian[i, 1] + gradient[2] * jacobian[i, 2]
        grad_means[i] = without_nan(grad_mean, gradient)

    return jacobian_backward


@cache
def harmonics_backward_kernel(dtype, degree: int, coefficients: bool):
    """Return the backward pass of harmonics_kernel() with respect to means and, if `coefficients`, to those.

    Gradients are written, not accumulated. grad_colors, grad_means: [N] vec3; grad_constant,
    grad_rest: as the coefficients; those of higher degrees are set to 0. The gradient with respect to the camera's
    position is the negative sum of grad_means.
    """
    without_nan = zero_if_unused(dtype)
    vec3 = geometry(dtype).vec3
    direction_of, harmonic = harmonic_functions(dtype)
    mean_gradient, weight_vector = mean_gradient_function(dtype, degree)
    columns = (degree + 1) * (degree + 1) - 1

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def harmonics_backward(
        range_start: int,
        rest: wp.array2d(dtype=vec3), means: wp.array(dtype=vec3), camera_position: wp.array(dtype=vec3),
        grad_colors: wp.array(dtype=vec3), grad_means: wp.array(dtype=vec3),
        grad_constant: wp.array2d(dtype=vec3), grad_rest: wp.array2d(dtype=vec3),
    ):
        i = range_start + wp.tid()
        gradient = grad_colors[i]
        direction = direction_of(means[i], camera_position[0])
        x = direction[0]
        y = direction[1]
        z = direction[2]
        if wp.static(coefficients):
            grad_constant[i, 0] = harmonic(0, x, y, z) * gradient
            for k in range(wp.static(columns)):
                grad_rest[i, k] = harmonic(k + 1, x, y, z) * gradient
            for column in range(wp.static(columns), grad_rest.shape[1]):
                grad_rest[i, column] = vec3()
        weights = weight_vector()
        for k in range(wp.static(columns)):
            weights[k] = wp.dot(rest[i, k], gradient)
        grad_means[i] = without_nan(mean_gradient(weights, direction), gradient)

    return harmonics_backward


@cache
def basis_kernel(dtype, degree: int):
    """Return the kernel of basis[v, k, i] = Y_k(direction from position v to mean i), [V, K, N], over V N threads."""
    vec3 = geometry(dtype).vec3
    direction_of, harmonic = harmonic_functions(dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def evaluate_basis(
        range_start: int,
        means: wp.array(dtype=vec3), positions: wp.array(dtype=vec3), basis: wp.array3d(dtype=dtype),
    ):
        index = range_start + wp.tid()
        view = index // means.shape[0]
        i = index - view * means.shape[0]
        d = direction_of(means[i], positions[view])
        for k in range(wp.static((degree + 1) * (degree + 1))):
            basis[view, k, i] = harmonic(k, d[0], d[1], d[2])

    return evaluate_basis


@cache
def coefficient_gradient(dtype, count: int):
    """Return the function that computes one number of the gradient with respect to coefficients [N, count, 3].

    index: index of the number in the flat gradient. start: index of the first coefficient; those beyond the basis
    [V, K, N] have gradient 0. grad_colors: [V, N, 3].
    """
    real = dtype

    @wp.func
    def gradient_of(
        index: int, start: int, basis: wp.array3d(dtype=real), grad_colors: wp.array3d(dtype=real)
    ) -> real:
        i = index // wp.static(3 * count)
        rest = index - i * wp.static(3 * count)
        k = start + rest // 3
        gradient = real(0.0)
        if k < basis.shape[1]:
            for view in range(basis.shape[0]):
                gradient += basis[view, k, i] * grad_colors[view, i, rest % 3]
        return gradient

    return gradient_of


@cache
def coefficient_backward_kernel(dtype, count: int):
    """Return the backward pass with respect to coefficients, with one thread for each number so that writes coalesce.

    A GPU takes several times as long if one thread writes all coefficients of a Gaussian. gradients: [3 N count], which
    is also the number of threads; otherwise as coefficient_gradient() takes them.
    """
    gradient_of = coefficient_gradient(dtype, count)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def coefficient_backward(
        range_start: int,
        basis: wp.array3d(dtype=dtype), grad_colors: wp.array3d(dtype=dtype), start: int,
        gradients: wp.array(dtype=dtype),
    ):
        index = range_start + wp.tid()
        gradients[index] = gradient_of(index, start, basis, grad_colors)

    return coefficient_backward
