"""Splats seen in all directions from one point, for environment maps: forward only, since nothing is trained on them.

A picture is any set of directions. One thread takes one Gaussian to the plane that touches the unit sphere in its own
direction n, where its perspective is a 2D Gaussian (Huang et al. 2024, On the Error Analysis of 3D Gaussian Splatting
and an Optimal Projection Strategy): no pixel is special, so there is no seam where a map wraps and nothing stretches at
its poles. The inverse covariance is kept as two vectors a and b across n, such that for any unit direction d

    exponent = -((a . d)^2 + (b . d)^2) / (2 (n . d)^2),    n . d > 0.

Within a cap around n a Gaussian counts. Directions come in tiles of 16 x 16, and these in blocks; each has a cap as
well, and two caps that do not meet share no pixel. A tile's list is ordered by distance and blended by one thread a
pixel, front to back.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .constants import ALPHA_MAX, LOG_SCALE_MAX, TILE_SIZE, TRANSMITTANCE_MIN
from .geometry import geometry, vector

# Tiles along the side of a block: the pairs of Gaussians and blocks are few, and so are the tiles of a block.
BLOCK_TILES = 8


@cache
def projection_kernel(dtype, antialiased: bool):
    """Gaussians to what blend reads of them.

    footprint: variance in square radians that a training pixel added. smoothing: variance beyond it, for pixels that
    are larger; it keeps a Gaussian's energy by lowering its opacity, as the footprint does where antialiased.
    """
    g = geometry(dtype)
    real, vec3, vec4 = g.real, g.vec3, g.vec4

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def project_to_sphere(
        first: int,
        means: wp.array(dtype=vec3), log_scales: wp.array(dtype=vec3), quaternions: wp.array(dtype=vec4),
        opacities: wp.array(dtype=real), position: wp.array(dtype=vec3),
        near: real, footprint: real, smoothing: real, alpha_threshold: real,
        caps: wp.array(dtype=vec4), across: wp.array(dtype=vec3), along: wp.array(dtype=vec3),
        opacities2d: wp.array(dtype=real), distances: wp.array(dtype=real),
    ):
        i = first + wp.tid()
        offset = means[i] - position[0]
        distance = wp.length(offset)
        usable = distance > near
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
        low_pass = footprint + smoothing
        blurred = bare + low_pass * energy + low_pass * low_pass
        opacity = opacities[i]
        if wp.static(antialiased):
            opacity = opacity * wp.sqrt(wp.max(bare / blurred, real(0.0)))
        else:
            opacity = opacity * wp.sqrt(trained / blurred)
        v00 = wp.dot(m0, m0) + low_pass
        v11 = wp.dot(m1, m1) + low_pass
        v01 = wp.dot(m0, m1)
        usable = usable and blurred > real(1.0e-30) and wp.isfinite(blurred) and opacity > alpha_threshold
        if usable:
            level = real(2.0) * wp.log(opacity / alpha_threshold)
            half = real(0.5) * (v00 + v11)
            widest = half + wp.sqrt(real(0.25) * (v00 - v11) * (v00 - v11) + v01 * v01)
            # The inverse covariance's root: rows of a triangular matrix.
            r00 = wp.sqrt(v11 / blurred)
            r01 = -v01 / (blurred * r00)
            r11 = wp.sqrt(real(1.0) / v11)
            caps[i] = vec4(n[0], n[1], n[2], wp.atan(wp.sqrt(level * widest)))
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
    """list_tiles and blend for one scalar type and number of channels."""
    g = geometry(dtype)
    real, vec3, vec4 = g.real, g.vec3, g.vec4
    features_type = vector(channels, dtype)
    options = {"enable_backward": False, "fuse_fp": False}

    @wp.func
    def caps_meet(one: vec4, other: vec4) -> bool:
        reach = wp.min(one[3] + other[3] + real(1.0e-6), real(3.1415926))
        return one[0] * other[0] + one[1] * other[1] + one[2] * other[2] >= wp.cos(reach)

    @wp.kernel(module="unique", module_options=options)
    def list_tiles(
        first: int, order: wp.array(dtype=wp.int32), caps: wp.array(dtype=vec4), tile_caps: wp.array(dtype=vec4),
        block_caps: wp.array(dtype=vec4), columns: int, rows: int, starts: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32), tiles: wp.array(dtype=wp.int32), gaussians: wp.array(dtype=wp.int32),
    ):
        """counts: the tiles that each Gaussian touches. Where tiles and gaussians have room, an entry for each of them
        from starts[place] on."""
        place = first + wp.tid()
        gaussian = order[place]
        cap = caps[gaussian]
        count = int(0)
        if cap[3] > real(0.0):
            across = (columns + BLOCK_TILES - 1) // BLOCK_TILES
            for block in range(block_caps.shape[0]):
                if caps_meet(cap, block_caps[block]):
                    top = (block // across) * BLOCK_TILES
                    left = (block % across) * BLOCK_TILES
                    for row in range(top, wp.min(top + BLOCK_TILES, rows)):
                        for column in range(left, wp.min(left + BLOCK_TILES, columns)):
                            if caps_meet(cap, tile_caps[row * columns + column]):
                                if tiles.shape[0] > 0:
                                    tiles[starts[place] + count] = row * columns + column
                                    gaussians[starts[place] + count] = gaussian
                                count += 1
        counts[place] = count

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def blend(
        first: int,
        ranges: wp.array(dtype=wp.vec2i), entries: wp.array(dtype=wp.int32), directions: wp.array(dtype=vec3),
        caps: wp.array(dtype=vec4), across: wp.array(dtype=vec3), along: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real), features: wp.array(dtype=features_type),
        columns: int, width: int, height: int, alpha_threshold: real,
        image: wp.array(dtype=features_type), transmittance: wp.array(dtype=real),
    ):
        # Pixels tile by tile, so that neighbors read the same list.
        thread = first + wp.tid()
        tile = thread // (TILE_SIZE * TILE_SIZE)
        place = thread - tile * (TILE_SIZE * TILE_SIZE)
        x = (tile % columns) * TILE_SIZE + place % TILE_SIZE
        y = (tile // columns) * TILE_SIZE + place // TILE_SIZE
        if x < width and y < height:
            pixel = y * width + x
            d = directions[pixel]
            bounds = ranges[tile]
            left_over = real(1.0)
            total = features_type()
            k = bounds[0]
            while k < bounds[1]:
                i = entries[k]
                k += 1
                cap = caps[i]
                forward = cap[0] * d[0] + cap[1] * d[1] + cap[2] * d[2]
                a = wp.dot(across[i], d)
                b = wp.dot(along[i], d)
                squared = a * a + b * b
                opacity = opacities[i]
                # exp(-18) of anything is below every threshold that is used.
                if forward > real(0.0) and squared < real(36.0) * forward * forward:
                    alpha = wp.min(
                        real(ALPHA_MAX), opacity * wp.exp(real(-0.5) * squared / (forward * forward))
                    )
                    if alpha > alpha_threshold:
                        remaining = left_over - left_over * alpha
                        if remaining <= real(TRANSMITTANCE_MIN):
                            k = bounds[1]
                        else:
                            total += features[i] * (alpha * left_over)
                            left_over = remaining
            image[pixel] = total
            transmittance[pixel] = left_over

    return SimpleNamespace(list_tiles=list_tiles, blend=blend)
