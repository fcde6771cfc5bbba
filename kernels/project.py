"""Projection of 3D Gaussians to 2D Gaussians (EWA splatting, Zwicker et al. 2001, as in 3DGS, Kerbl et al. 2023).

One thread takes one Gaussian to the camera, linearizes the perspective at its center and writes the center in pixels,
the inverse of the 2D covariance (the conic), the depth, the opacity and the half-extent of the region in which its
alpha reaches the threshold. Everything but the extents is differentiable; Warp generates the adjoint.

The covariance is formed as a Gram matrix, M M^T + eps2d I with M = J W R diag(scale), and its determinant as
|m0 x m1|^2 + eps2d (|m0|^2 + |m1|^2) + eps2d^2 over M's rows (Cauchy-Binet): no term is ever subtracted, so a
needle of any aspect ratio keeps a positive determinant.
"""

from functools import cache

import warp as wp

from .constants import FRUSTUM_MARGIN, LOG_SCALE_MAX, cpu_flags
from .geometry import geometry, matrix


@cache
def projection_kernel(dtype, antialiased: bool, differentiate_compensation: bool, own_cameras: bool):
    """Return the projection kernel for one scalar type.

    The kernel's `visibility` is the forward pass's extents in the adjoint, and None in the forward pass. Its `limit_x`
    and `limit_y` are the largest x/z and y/z at which it linearizes the perspective, infinite for that of the image.

    antialiased: lower the opacity by sqrt(det / det_blurred), so that the blur by eps2d keeps a Gaussian's energy (Yu
    et al. 2024, Mip-Splatting). differentiate_compensation: differentiate that factor with respect to the covariance,
    as gsplat does; otherwise it is constant in the gradient. own_cameras: each Gaussian has a row of
    world_to_camera and intrinsics, so that no two add to the same gradient; otherwise all share the first row.
    """
    g = geometry(dtype)
    real, vec2, vec3, vec4, mat44 = g.real, g.vec2, g.vec3, g.vec4, g.mat44
    mat23 = matrix(2, 3, dtype)

    @wp.func
    def compensation(determinant: real, blurred: real) -> real:
        return wp.sqrt(wp.max(determinant / blurred, real(0.0)))

    if differentiate_compensation:

        @wp.func_grad(compensation)
        def _gradient(determinant: real, blurred: real, adj_ret: real):
            ratio = wp.max(determinant / blurred, real(0.0))
            # A small addition keeps the slope of the root finite.
            slope = adj_ret * real(0.5) / ((wp.sqrt(ratio) + real(1.0e-6)) * blurred)
            wp.adjoint[determinant] += slope
            wp.adjoint[blurred] += -slope * ratio

    else:

        @wp.func_grad(compensation)
        def _no_gradient(determinant: real, blurred: real, adj_ret: real):
            pass

    @wp.kernel(module="unique", module_options={"enable_backward": True, "cpu_compiler_flags": cpu_flags()})
    def project(
        range_start: int,
        means: wp.array(dtype=vec3), log_scales: wp.array(dtype=vec3), quaternions: wp.array(dtype=vec4),
        opacities: wp.array(dtype=real), world_to_camera: wp.array(dtype=mat44),
        intrinsics: wp.array(dtype=vec4),
        width: int, height: int, near_plane: real, eps2d: real, alpha_threshold: real,
        limit_x: real, limit_y: real, visibility: wp.array(dtype=vec2),
        # outputs
        means2d: wp.array(dtype=vec2), conics: wp.array(dtype=vec3), depths: wp.array(dtype=real),
        opacities2d: wp.array(dtype=real), extents: wp.array(dtype=vec2),
    ):
        i = range_start + wp.tid()
        # In the adjoint: a culled Gaussian has no gradient, and 0 times an infinite derivative must not become one.
        if visibility:
            if visibility[i][0] <= real(0.0):
                return
        camera = i * wp.static(int(own_cameras))
        pose = world_to_camera[camera]
        pinhole = intrinsics[camera]
        fx = pinhole[0]
        fy = pinhole[1]
        rotation = g.mat33(
            pose[0, 0], pose[0, 1], pose[0, 2],
            pose[1, 0], pose[1, 1], pose[1, 2],
            pose[2, 0], pose[2, 1], pose[2, 2],
        )
        center = rotation * means[i] + vec3(pose[0, 3], pose[1, 3], pose[2, 3])
        depth = center[2]
        in_front = depth > near_plane
        z = wp.where(in_front, depth, real(1.0))
        inverse_z = real(1.0) / z
        x_ratio = wp.where(in_front, center[0], real(0.0)) * inverse_z
        y_ratio = wp.where(in_front, center[1], real(0.0)) * inverse_z
        pixel = vec2(fx * x_ratio + pinhole[2], fy * y_ratio + pinhole[3])

        # Far off the axis the linearization explodes: hold its ray near the frustum, and within the limits.
        w = real(width)
        h = real(height)
        margin = real(FRUSTUM_MARGIN)
        ray_x = wp.clamp(
            x_ratio, -(pinhole[2] + margin * w * real(0.5)) / fx, (w - pinhole[2] + margin * w * real(0.5)) / fx
        )
        ray_y = wp.clamp(
            y_ratio, -(pinhole[3] + margin * h * real(0.5)) / fy, (h - pinhole[3] + margin * h * real(0.5)) / fy
        )
        ray_x = wp.clamp(ray_x, -limit_x, limit_x)
        ray_y = wp.clamp(ray_y, -limit_y, limit_y)
        jacobian = mat23(
            fx * inverse_z, real(0.0), -fx * ray_x * inverse_z,
            real(0.0), fy * inverse_z, -fy * ray_y * inverse_z,
        )

        limit = real(LOG_SCALE_MAX)
        log_scale = log_scales[i]
        scale_x = wp.exp(wp.clamp(log_scale[0], -limit, limit))
        scale_y = wp.exp(wp.clamp(log_scale[1], -limit, limit))
        scale_z = wp.exp(wp.clamp(log_scale[2], -limit, limit))
        axes = rotation * g.rotation_from_quaternion(quaternions[i])
        spread = jacobian * axes
        m0 = vec3(spread[0, 0] * scale_x, spread[0, 1] * scale_y, spread[0, 2] * scale_z)
        m1 = vec3(spread[1, 0] * scale_x, spread[1, 1] * scale_y, spread[1, 2] * scale_z)
        variance_x = wp.dot(m0, m0) + eps2d
        variance_y = wp.dot(m1, m1) + eps2d
        covariance = wp.dot(m0, m1)
        area = wp.cross(m0, m1)
        determinant = wp.dot(area, area)
        blurred = determinant + eps2d * (wp.dot(m0, m0) + wp.dot(m1, m1)) + eps2d * eps2d

        opacity = opacities[i]
        if wp.static(antialiased):
            opacity = opacity * compensation(determinant, blurred)

        # wp.clamp() makes a bound of NaN, so the sizes are tested themselves.
        finite = (
            wp.isfinite(blurred) and wp.isfinite(opacity) and wp.isfinite(log_scale[0]) and wp.isfinite(log_scale[1])
            and wp.isfinite(log_scale[2])
        )
        usable = in_front and blurred > real(1.0e-12) and finite and opacity > alpha_threshold
        extent_x = real(0.0)
        extent_y = real(0.0)
        if usable:
            cutoff = real(2.0) * wp.log(opacity / alpha_threshold)
            extent_x = wp.sqrt(cutoff * variance_x)
            extent_y = wp.sqrt(cutoff * variance_y)
        # Keep only what reaches into this image.
        usable = (
            usable and pixel[0] + extent_x > real(0.0) and pixel[0] - extent_x < w
            and pixel[1] + extent_y > real(0.0) and pixel[1] - extent_y < h
        )
        if usable:
            inverse = real(1.0) / blurred
            means2d[i] = pixel
            conics[i] = vec3(variance_y * inverse, -covariance * inverse, variance_x * inverse)
            depths[i] = depth
            opacities2d[i] = opacity
            extents[i] = vec2(extent_x, extent_y)
        else:
            means2d[i] = vec2(real(0.0), real(0.0))
            conics[i] = vec3(real(1.0), real(0.0), real(1.0))
            depths[i] = real(0.0)
            opacities2d[i] = real(0.0)
            extents[i] = vec2(real(0.0), real(0.0))

    return project
