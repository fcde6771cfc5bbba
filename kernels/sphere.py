"""Splats seen in all directions from one point: environment maps, and panoramas as photos.

A picture is any set of directions. One thread takes one Gaussian to the plane that touches the unit sphere in its own
direction n, where its perspective is a 2D Gaussian (Huang et al. 2024, On the Error Analysis of 3D Gaussian Splatting
and an Optimal Projection Strategy): no pixel is special, so there is no seam where a map wraps and nothing stretches at
its poles. The inverse covariance is kept as two vectors a and b across n, such that for any unit direction d

    exponent = -((a . d)^2 + (b . d)^2) / (2 (n . d)^2),    n . d > 0.

Within a cap around n a Gaussian counts. Directions come in tiles of 16 x 16, and these in blocks; each has a cap as
well, and two caps that do not meet share no pixel. A tile's list is ordered by distance and blended front to back: by
one thread a pixel, on the CPU by sphere_cpu.py. The backward pass walks it back to front as that of blend_cpu.py does.
Warp generates the adjoint of the projection.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .constants import ALPHA_MAX, LOG_SCALE_MAX, NO_AUTODIFF, TRANSMITTANCE_MIN, cpu_flags
from .geometry import geometry, pixel_of_thread, vector

# Tiles along the side of a block: the pairs of Gaussians and blocks are few, and so are the tiles of a block.
BLOCK_TILES = 8


@cache
def projection_kernel(dtype, antialiased: bool, own_positions: bool):
    """Return the kernel that projects Gaussians to caps of the unit sphere, as blend reads them.

    footprint: variance in square radians that a training pixel added. smoothing: variance beyond it, for pixels that
    are larger; it keeps a Gaussian's energy by lowering its opacity, as the footprint does where antialiased.
    own_positions: each Gaussian has a row of position, as of world_to_camera in project.py; otherwise all share one.
    """
    g = geometry(dtype)
    real, vec3, vec4 = g.real, g.vec3, g.vec4

    @wp.kernel(module="unique", module_options={"enable_backward": True, "cpu_compiler_flags": cpu_flags()})
    def project_to_sphere(
        range_start: int,
        means: wp.array(dtype=vec3), log_scales: wp.array(dtype=vec3), quaternions: wp.array(dtype=vec4),
        opacities: wp.array(dtype=real), position: wp.array(dtype=vec3),
        near_plane: real, footprint: real, smoothing: real, alpha_threshold: real,
        visibility: wp.array(dtype=real),
        # outputs
        caps: wp.array(dtype=vec4), across: wp.array(dtype=vec3), along: wp.array(dtype=vec3),
        opacities2d: wp.array(dtype=real), distances: wp.array(dtype=real),
    ):
        # The limits below that nothing usable reaches keep the adjoint of a square root from dividing by 0.
        tiny = real(1.0e-30)
        i = range_start + wp.tid()
        # As in project.py: in the adjoint a culled Gaussian has no gradient.
        if visibility:
            if visibility[i] <= real(0.0):
                return
        offset = means[i] - position[i * wp.static(int(own_positions))]
        distance = wp.length(offset)
        usable = distance > near_plane
        n = offset / wp.where(usable, distance, real(1.0))
        # Two axes of the tangent plane, from the coordinate axis that n is farthest from.
        helper = vec3(real(1.0), real(0.0), real(0.0))
        if wp.abs(n[0]) > wp.abs(n[1]):
            helper = vec3(real(0.0), real(1.0), real(0.0))
        e0 = wp.normalize(wp.cross(n, helper))
        e1 = wp.cross(n, e0)

        limit = real(LOG_SCALE_MAX)
        log_scale = log_scales[i]
        inverse_distance = real(1.0) / wp.where(usable, distance, real(1.0))
        scale = vec3(
            wp.exp(wp.clamp(log_scale[0], -limit, limit)), wp.exp(wp.clamp(log_scale[1], -limit, limit)),
            wp.exp(wp.clamp(log_scale[2], -limit, limit)),
        ) * inverse_distance
        axes = g.rotation_from_quaternion(quaternions[i])
        m0 = wp.cw_mul(wp.transpose(axes) * e0, scale)
        m1 = wp.cw_mul(wp.transpose(axes) * e1, scale)
        # As in project.py: no determinant is a difference.
        energy = wp.dot(m0, m0) + wp.dot(m1, m1)
        area = wp.cross(m0, m1)
        bare = wp.dot(area, area)
        trained = bare + footprint * energy + footprint * footprint
        eps2d = footprint + smoothing
        blurred = bare + eps2d * energy + eps2d * eps2d
        opacity = opacities[i]
        if wp.static(antialiased):
            opacity = opacity * wp.sqrt(wp.max(bare / blurred, tiny))
        else:
            opacity = opacity * wp.sqrt(trained / blurred)
        v00 = wp.dot(m0, m0) + eps2d
        v11 = wp.dot(m1, m1) + eps2d
        v01 = wp.dot(m0, m1)
        usable = usable and blurred > tiny and wp.isfinite(blurred) and opacity > alpha_threshold
        usable = usable and wp.isfinite(opacity) and wp.isfinite(log_scale[0]) and wp.isfinite(log_scale[1])
        usable = usable and wp.isfinite(log_scale[2])
        if usable:
            cutoff = real(2.0) * wp.log(opacity / alpha_threshold)
            half = real(0.5) * (v00 + v11)
            widest = half + wp.sqrt(wp.max(real(0.25) * (v00 - v11) * (v00 - v11) + v01 * v01, tiny))
            # The inverse covariance's root: rows of a triangular matrix.
            r00 = wp.sqrt(v11 / blurred)
            r01 = -v01 / (blurred * r00)
            r11 = wp.sqrt(real(1.0) / v11)
            caps[i] = vec4(n[0], n[1], n[2], wp.atan(wp.sqrt(cutoff * widest)))
            across[i] = r00 * e0 + r01 * e1
            along[i] = r11 * e1
            opacities2d[i] = opacity
            distances[i] = distance
        else:
            caps[i] = vec4(real(0.0), real(0.0), real(1.0), real(0.0))
            across[i] = vec3()
            along[i] = vec3()
            opacities2d[i] = real(0.0)
            distances[i] = real(0.0)

    return project_to_sphere


@cache
def sphere_kernels(dtype, channels: int) -> SimpleNamespace:
    """Return list_tiles, blend and blend_backward for one scalar type and number of channels."""
    g = geometry(dtype)
    real, vec2, vec3, vec4 = g.real, vector(2, dtype), g.vec3, g.vec4
    features_type = vector(channels, dtype)
    options = NO_AUTODIFF | {"fuse_fp": False}

    @wp.func
    def caps_meet(middle: real, cosine: real, sine: real, other_cosine: real, other_sine: real) -> bool:
        """Return whether caps meet; middle: cosine between their axes, the others: of their angles."""
        apart = cosine * other_cosine - sine * other_sine - real(1.0e-6)
        return cosine + other_cosine <= real(0.0) or middle >= apart

    @wp.func
    def falloff(squared: real, forward: real) -> real:
        """Return the factor of a Gaussian's opacity; 0 behind the viewer, and below exp(-18), under every threshold."""
        value = real(0.0)
        if forward > real(0.0) and squared < real(36.0) * forward * forward:
            value = wp.exp(real(-0.5) * squared / (forward * forward))
        return value

    @wp.kernel(module="unique", module_options=options)
    def list_tiles(
        range_start: int, order: wp.array(dtype=wp.int32), caps: wp.array(dtype=vec4),
        tile_axes: wp.array(dtype=vec3), tile_angles: wp.array(dtype=vec2),
        block_axes: wp.array(dtype=vec3), block_angles: wp.array(dtype=vec2),
        columns: int, rows: int, starts: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32), tiles: wp.array(dtype=wp.int32), gaussians: wp.array(dtype=wp.int32),
    ):
        """Count the tiles that each Gaussian touches and, if there is memory, list them.

        Intersections of the Gaussian at `nth` in the order are written from starts[nth] on. tile_angles, block_angles:
        cosine and sine of each cap's angle.
        """
        nth = range_start + wp.tid()
        gaussian = order[nth]
        cap = caps[gaussian]
        count = int(0)
        if cap[3] > real(0.0):
            axis = vec3(cap[0], cap[1], cap[2])
            cosine = wp.cos(cap[3])
            sine = wp.sin(cap[3])
            across = (columns + BLOCK_TILES - 1) // BLOCK_TILES
            for block in range(block_axes.shape[0]):
                angle = block_angles[block]
                if caps_meet(wp.dot(axis, block_axes[block]), cosine, sine, angle[0], angle[1]):
                    top = (block // across) * BLOCK_TILES
                    left = (block % across) * BLOCK_TILES
                    for row in range(top, wp.min(top + BLOCK_TILES, rows)):
                        for column in range(left, wp.min(left + BLOCK_TILES, columns)):
                            tile = row * columns + column
                            angle = tile_angles[tile]
                            if caps_meet(wp.dot(axis, tile_axes[tile]), cosine, sine, angle[0], angle[1]):
                                if tiles.shape[0] > 0:
                                    tiles[starts[nth] + count] = tile
                                    gaussians[starts[nth] + count] = gaussian
                                count += 1
        counts[nth] = count

    @wp.kernel(module="unique", module_options=options)
    def blend(
        range_start: int,
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        directions: wp.array(dtype=vec3),
        caps: wp.array(dtype=vec4), across: wp.array(dtype=vec3), along: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real), features: wp.array(dtype=features_type),
        columns: int, width: int, height: int, alpha_threshold: real,
        image: wp.array(dtype=features_type), transmittance: wp.array(dtype=real), ends: wp.array(dtype=wp.int32),
    ):
        """Blend each pixel's list front to back. ends: one past the last intersection that a pixel shows."""
        tile_x_y = pixel_of_thread(range_start + wp.tid(), columns)
        if tile_x_y[1] < width and tile_x_y[2] < height:
            pixel = tile_x_y[2] * width + tile_x_y[1]
            d = directions[pixel]
            bounds = tile_ranges[tile_x_y[0]]
            t = real(1.0)
            total = features_type()
            end = bounds[0]
            k = bounds[0]
            while k < bounds[1]:
                i = gaussians[k]
                k += 1
                cap = caps[i]
                a = wp.dot(across[i], d)
                b = wp.dot(along[i], d)
                value = falloff(a * a + b * b, cap[0] * d[0] + cap[1] * d[1] + cap[2] * d[2])
                alpha = wp.min(real(ALPHA_MAX), opacities[i] * value)
                if alpha > alpha_threshold:
                    remaining = t - t * alpha
                    if remaining <= real(TRANSMITTANCE_MIN):
                        k = bounds[1]
                    else:
                        total += features[i] * (alpha * t)
                        t = remaining
                        end = k
            image[pixel] = total
            transmittance[pixel] = t
            ends[pixel] = end

    @wp.kernel(module="unique", module_options=options)
    def blend_backward(
        range_start: int,
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        directions: wp.array(dtype=vec3),
        caps: wp.array(dtype=vec4), across: wp.array(dtype=vec3), along: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real), features: wp.array(dtype=features_type),
        columns: int, width: int, height: int, alpha_threshold: real,
        transmittance: wp.array(dtype=real), ends: wp.array(dtype=wp.int32), emit_indices: wp.array(dtype=wp.int32),
        grad_image: wp.array(dtype=features_type), grad_transmittance: wp.array(dtype=real),
        gradients: wp.array2d(dtype=real),
    ):
        """Add to gradients[emit_indices[k]] those of cap direction, across, along (3 each), opacity, features."""
        tile_x_y = pixel_of_thread(range_start + wp.tid(), columns)
        if tile_x_y[1] < width and tile_x_y[2] < height:
            pixel = tile_x_y[2] * width + tile_x_y[1]
            d = directions[pixel]
            grad_pixel = grad_image[pixel]
            t = transmittance[pixel]
            grad_from_behind = t * grad_transmittance[pixel]
            begin = tile_ranges[tile_x_y[0]][0]
            k = ends[pixel]
            while k > begin:
                k -= 1
                i = gaussians[k]
                cap = caps[i]
                forward = cap[0] * d[0] + cap[1] * d[1] + cap[2] * d[2]
                a = wp.dot(across[i], d)
                b = wp.dot(along[i], d)
                value = falloff(a * a + b * b, forward)
                unclamped = opacities[i] * value
                alpha = wp.min(real(ALPHA_MAX), unclamped)
                if alpha > alpha_threshold:
                    row = emit_indices[k]
                    inverse = real(1.0) / (real(1.0) - alpha)
                    # As an addition: t * inverse would round each of many faint factors the same way.
                    t += t * (alpha * inverse)
                    through = wp.dot(features[i], grad_pixel)
                    grad_alpha = t * through - grad_from_behind * inverse
                    weight = alpha * t
                    grad_from_behind += weight * through
                    for channel in range(wp.static(channels)):
                        wp.atomic_add(gradients, row, 10 + channel, weight * grad_pixel[channel])
                    if unclamped < real(ALPHA_MAX):
                        slope = alpha * grad_alpha / (forward * forward)
                        grad_forward = slope * (a * a + b * b) / forward
                        for axis in range(3):
                            wp.atomic_add(gradients, row, axis, grad_forward * d[axis])
                            wp.atomic_add(gradients, row, 3 + axis, -slope * a * d[axis])
                            wp.atomic_add(gradients, row, 6 + axis, -slope * b * d[axis])
                        wp.atomic_add(gradients, row, 9, value * grad_alpha)

    return SimpleNamespace(list_tiles=list_tiles, blend=blend, blend_backward=blend_backward)
