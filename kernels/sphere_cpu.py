"""The blend of sphere.py and its backward pass for the CPU: rows of 8 pixels, branch-free, as in blend_cpu.py.

One kernel index is one tile of 16 x 16 pixels. Of each Gaussian in the tile's list the kernels walk the rows whose cap
meets the Gaussian's. The backward pass writes the gradients of each intersection, so that their sums keep one order.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from .blend_cpu import HALVES, LANES, row_functions, row_options
from .constants import ALPHA_MAX, TILE_SIZE, TRANSMITTANCE_MIN
from .geometry import geometry, vector

ROWS = HALVES * TILE_SIZE  # Rows of a tile, 16 of each half


class DirectionFunctions(NamedTuple):
    """Type of a row's cap, and Warp functions of the directions of a tile's rows."""

    cap_of_row: Any  # Mean direction of a row, cosine and sine of the angle to its farthest; cosine -1 if it may be any
    load_directions: Any  # Fills the directions and caps of a tile's rows
    meets: Any  # Whether a Gaussian's cap meets that of a row
    dots: Any  # Scalar products of a row's directions with a vector
    falloff: Any  # Factors of a Gaussian's opacity


@cache
def direction_functions(dtype, exp_squarings: int) -> DirectionFunctions:
    """Return what both kernels do with directions; exp_squarings: see row_functions()."""
    _, broadcast, heaviside, exponential, _ = row_functions(dtype, exp_squarings)
    g = geometry(dtype)
    real, vec3, vec4, size, lanes = g.real, g.vec3, g.vec4, TILE_SIZE, LANES
    row, cap_of_row = vector(LANES, dtype), vector(5, dtype)

    @wp.func
    def load_directions(
        index: int, x0: int, y0: int, width: int, height: int, directions: wp.array(dtype=vec3),
        row_directions: wp.array3d(dtype=row), row_caps: wp.array2d(dtype=cap_of_row),
    ):
        """Fill the directions and caps of the rows of a tile, whose first pixel is (x0, y0)."""
        for at in range(row_caps.shape[1]):
            # Of pixels beyond the picture's border no direction is known, and 0 is in front of no Gaussian.
            dx = row(real(0.0))
            dy = row(real(0.0))
            dz = row(real(0.0))
            total = vec3()
            left = x0 + (at // size) * lanes
            y = y0 + at % size
            known = int(0)
            if y < height:
                known = wp.clamp(width - left, 0, lanes)
            for lane in range(known):
                d = directions[y * width + left + lane]
                dx[lane] = d[0]
                dy[lane] = d[1]
                dz[lane] = d[2]
                total += d
            row_directions[index, 0, at] = dx
            row_directions[index, 1, at] = dy
            row_directions[index, 2, at] = dz
            length = wp.length(total)
            lowest = length
            for lane in range(known):
                lowest = wp.min(lowest, wp.dot(total, vec3(dx[lane], dy[lane], dz[lane])))
            cap = cap_of_row(real(0.0), real(0.0), real(0.0), real(-1.0), real(0.0))
            # Where directions spread far, as around a pole, any Gaussian may be in the row.
            if length > real(1.0e-3) and lowest > real(0.0):
                # Rounding of a cosine near 1 is worth an angle of 3e-4.
                cosine = wp.max(lowest / length - real(1.0e-6), real(0.0))
                sine = wp.sqrt(real(1.0) - cosine * cosine)
                cap = cap_of_row(total[0] / length, total[1] / length, total[2] / length, cosine, sine)
            row_caps[index, at] = cap

    @wp.func
    def meets(cap: vec4, cosine: real, sine: real, other: cap_of_row) -> bool:
        """Return whether the cap of a Gaussian meets that of a row; cosine, sine: of the angle of the Gaussian's."""
        middle = cap[0] * other[0] + cap[1] * other[1] + cap[2] * other[2]
        return other[3] < real(0.0) or middle >= cosine * other[3] - sine * other[4] - real(1.0e-6)

    @wp.func
    def dots(row_directions: wp.array3d(dtype=row), index: int, at: int, other: vec3) -> row:
        across = row_directions[index, 0, at] * other[0] + row_directions[index, 1, at] * other[1]
        return across + row_directions[index, 2, at] * other[2]

    @wp.func
    def falloff(squared: row, forward: row) -> row:
        """Return factors of opacity: 0 behind the viewer and below exp(-18), as in sphere.py."""
        depth = wp.max(wp.cw_mul(forward, forward), broadcast(real(1.0e-30)))
        p = wp.cw_div(squared, depth) * real(-0.5)
        return wp.cw_mul(exponential(p), wp.cw_mul(heaviside(forward), heaviside(p + broadcast(real(18.0)))))

    return DirectionFunctions(cap_of_row, load_directions, meets, dots, falloff)


@cache
def forward_kernel(dtype, channels: int, exp_squarings: int):
    """Return blend_forward(), launched over tiles.

    exp_squarings: see row_functions().

    The kernel's arguments:
        first_tile: tile of index 0; scratch is for as many tiles as indices.
        tile_ranges, gaussians, directions, caps, across, along, opacities: as of blend() in sphere.py.
        features: [N, C].
        row_directions: scratch, [indices, 3, 32] rows.
        row_caps: scratch, [indices, 32], a row's mean direction, and cosine and sine of the angle to its farthest.
        tile_transmittance, last_contributor: scratch, [indices, 32] rows.
        accumulated: scratch, [indices, C, 32] rows.
        image, transmittance, ends: as of blend() in sphere.py; [H W, C], [H W], [H W].
    """
    row, broadcast, heaviside, _, _ = row_functions(dtype, exp_squarings)
    cap_of_row, load_directions, meets, dots, falloff = direction_functions(dtype, exp_squarings)
    g = geometry(dtype)
    real, vec3, vec4, size, lanes = g.real, g.vec3, g.vec4, TILE_SIZE, LANES

    @wp.kernel(module="unique", module_options=row_options(dtype))
    def blend_forward(
        range_start: int, first_tile: int,
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        directions: wp.array(dtype=vec3),
        caps: wp.array(dtype=vec4), across: wp.array(dtype=vec3), along: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real), features: wp.array2d(dtype=real),
        columns: int, width: int, height: int, alpha_threshold: real,
        row_directions: wp.array3d(dtype=row), row_caps: wp.array2d(dtype=cap_of_row),
        tile_transmittance: wp.array2d(dtype=row), last_contributor: wp.array2d(dtype=row),
        accumulated: wp.array3d(dtype=row),
        image: wp.array2d(dtype=real), transmittance: wp.array(dtype=real), ends: wp.array(dtype=wp.int32),
    ):
        index = range_start + wp.tid()
        tile = first_tile + index
        bounds = tile_ranges[tile]
        x0 = (tile % columns) * size
        y0 = (tile // columns) * size
        # Not a constant of 32, which the compiler would take five times as long to write out.
        rows = tile_transmittance.shape[1]
        for at in range(rows):
            tile_transmittance[index, at] = broadcast(real(1.0))
            last_contributor[index, at] = broadcast(real(0.0))
            for channel in range(wp.static(channels)):
                accumulated[index, channel, at] = broadcast(real(0.0))
        load_directions(index, x0, y0, width, height, directions, row_directions, row_caps)

        k = bounds[0]
        alive = bool(True)
        while k < bounds[1] and alive:
            i = gaussians[k]
            cap = caps[i]
            a = across[i]
            b = along[i]
            cosine = wp.cos(cap[3])
            sine = wp.sin(cap[3])
            opacity = opacities[i]
            last = wp.where(opacity > alpha_threshold, rows, 0)  # Others may have features that are not finite.
            for at in range(last):
                if meets(cap, cosine, sine, row_caps[index, at]):
                    forward = dots(row_directions, index, at, vec3(cap[0], cap[1], cap[2]))
                    u = dots(row_directions, index, at, a)
                    v = dots(row_directions, index, at, b)
                    value = falloff(wp.cw_mul(u, u) + wp.cw_mul(v, v), forward)
                    alpha = wp.min(value * opacity, broadcast(real(ALPHA_MAX)))
                    t = tile_transmittance[index, at]
                    eligible = wp.cw_mul(heaviside(alpha - broadcast(alpha_threshold)), heaviside(t))
                    weight = wp.cw_mul(wp.cw_mul(alpha, t), eligible)
                    goes_on = heaviside(t - weight - broadcast(real(TRANSMITTANCE_MIN)))
                    weight = wp.cw_mul(weight, goes_on)
                    # The pixel that this Gaussian finishes keeps its T, negated; finished ones have eligible = 0.
                    finished = eligible - wp.cw_mul(eligible, goes_on)
                    tile_transmittance[index, at] = t - weight - wp.cw_mul(t, finished) * real(2.0)
                    contributes = wp.cw_mul(eligible, goes_on)
                    previous = last_contributor[index, at]
                    change = broadcast(real(k - bounds[0] + 1)) - previous
                    last_contributor[index, at] = previous + wp.cw_mul(contributes, change)
                    for channel in range(wp.static(channels)):
                        feature = features[i, channel]
                        accumulated[index, channel, at] = accumulated[index, channel, at] + weight * feature
            k += 1
            if (k - bounds[0]) % 32 == 0:
                most = broadcast(real(0.0))
                for at in range(rows):
                    most += wp.max(tile_transmittance[index, at], broadcast(real(0.0)))
                alive = wp.dot(most, broadcast(real(1.0))) > real(0.0)

        for j in range(wp.min(size, height - y0)):
            for x in range(wp.min(size, width - x0)):
                pixel = (y0 + j) * width + x0 + x
                half = x // lanes
                at = half * size + j
                lane = x - half * lanes
                transmittance[pixel] = wp.abs(tile_transmittance[index, at][lane])
                ends[pixel] = bounds[0] + int(last_contributor[index, at][lane])
                for channel in range(wp.static(channels)):
                    image[pixel, channel] = accumulated[index, channel, at][lane]

    return blend_forward


@cache
def backward_kernel(dtype, channels: int, exp_squarings: int):
    """Return blend_backward(), launched over tiles as forward_kernel(), whose arguments it shares.

    Its other arguments:
        transmittance, ends: as the forward kernel left them.
        emit_indices: [M] index of each intersection in grad_intersections.
        grad_image: [H W, C].
        grad_transmittance: [H W].
        tile_transmittance, last_contributor, grad_from_behind: scratch, [indices, 32] rows.
        tile_grad_image: scratch, [indices, C, 32] rows.
        sums: scratch, [indices, C] rows.
        grad_intersections: [M, C + 10] of cap direction, across, along (3 each), opacity, features; begins as zeros.
    """
    row, broadcast, heaviside, _, _ = row_functions(dtype, exp_squarings)
    cap_of_row, load_directions, meets, dots, falloff = direction_functions(dtype, exp_squarings)
    g = geometry(dtype)
    real, vec3, vec4, size, lanes = g.real, g.vec3, g.vec4, TILE_SIZE, LANES

    @wp.kernel(module="unique", module_options=row_options(dtype))
    def blend_backward(
        range_start: int, first_tile: int,
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        directions: wp.array(dtype=vec3),
        caps: wp.array(dtype=vec4), across: wp.array(dtype=vec3), along: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real), features: wp.array2d(dtype=real),
        columns: int, width: int, height: int, alpha_threshold: real,
        row_directions: wp.array3d(dtype=row), row_caps: wp.array2d(dtype=cap_of_row),
        tile_transmittance: wp.array2d(dtype=row), last_contributor: wp.array2d(dtype=row),
        tile_grad_image: wp.array3d(dtype=row), grad_from_behind: wp.array2d(dtype=row), sums: wp.array2d(dtype=row),
        transmittance: wp.array(dtype=real), ends: wp.array(dtype=wp.int32), emit_indices: wp.array(dtype=wp.int32),
        grad_image: wp.array2d(dtype=real), grad_transmittance: wp.array(dtype=real),
        grad_intersections: wp.array2d(dtype=real),
    ):
        index = range_start + wp.tid()
        tile = first_tile + index
        bounds = tile_ranges[tile]
        x0 = (tile % columns) * size
        y0 = (tile // columns) * size
        ones = broadcast(real(1.0))
        rows = tile_transmittance.shape[1]
        load_directions(index, x0, y0, width, height, directions, row_directions, row_caps)
        blend_count = int(0)
        for at in range(rows):
            t = broadcast(real(0.0))
            last = broadcast(real(0.0))
            from_transmittance = broadcast(real(0.0))
            for channel in range(wp.static(channels)):
                tile_grad_image[index, channel, at] = broadcast(real(0.0))
            left = x0 + (at // size) * lanes
            y = y0 + at % size
            if y < height:
                for lane in range(wp.min(lanes, width - left)):
                    pixel = y * width + left + lane
                    t[lane] = transmittance[pixel]
                    last[lane] = real(ends[pixel] - bounds[0])
                    blend_count = wp.max(blend_count, ends[pixel] - bounds[0])
                    from_transmittance[lane] = grad_transmittance[pixel]
                    for channel in range(wp.static(channels)):
                        tile_grad_image[index, channel, at][lane] = grad_image[pixel, channel]
            tile_transmittance[index, at] = t
            last_contributor[index, at] = last
            grad_from_behind[index, at] = wp.cw_mul(t, from_transmittance)

        for step_back in range(blend_count):
            k = bounds[0] + blend_count - 1 - step_back
            i = gaussians[k]
            cap = caps[i]
            a = across[i]
            b = along[i]
            cosine = wp.cos(cap[3])
            sine = wp.sin(cap[3])
            opacity = opacities[i]
            order = broadcast(real(k - bounds[0]) + real(0.5))
            for channel in range(wp.static(channels)):
                sums[index, channel] = broadcast(real(0.0))
            axis_x = broadcast(real(0.0))
            axis_y = broadcast(real(0.0))
            axis_z = broadcast(real(0.0))
            across_x = broadcast(real(0.0))
            across_y = broadcast(real(0.0))
            across_z = broadcast(real(0.0))
            along_x = broadcast(real(0.0))
            along_y = broadcast(real(0.0))
            along_z = broadcast(real(0.0))
            from_opacity = broadcast(real(0.0))
            last_row = wp.where(opacity > alpha_threshold, rows, 0)
            for at in range(last_row):
                if meets(cap, cosine, sine, row_caps[index, at]):
                    forward = dots(row_directions, index, at, vec3(cap[0], cap[1], cap[2]))
                    u = dots(row_directions, index, at, a)
                    v = dots(row_directions, index, at, b)
                    squared = wp.cw_mul(u, u) + wp.cw_mul(v, v)
                    value = falloff(squared, forward)
                    unclamped = value * opacity
                    alpha = wp.min(unclamped, broadcast(real(ALPHA_MAX)))
                    not_behind = heaviside(last_contributor[index, at] - order)
                    contributes = wp.cw_mul(heaviside(alpha - broadcast(alpha_threshold)), not_behind)
                    inverse = wp.cw_div(ones, ones - alpha)
                    t = tile_transmittance[index, at]
                    # As an addition: t * inverse would round each of many faint factors the same way.
                    t = t + wp.cw_mul(wp.cw_mul(t, wp.cw_mul(alpha, inverse)), contributes)
                    tile_transmittance[index, at] = t
                    q = tile_grad_image[index, 0, at] * features[i, 0]
                    for channel in range(1, wp.static(channels)):
                        q += tile_grad_image[index, channel, at] * features[i, channel]
                    r = grad_from_behind[index, at]
                    weight = wp.cw_mul(wp.cw_mul(alpha, t), contributes)
                    grad_from_behind[index, at] = r + wp.cw_mul(weight, q)
                    for channel in range(wp.static(channels)):
                        term = wp.cw_mul(weight, tile_grad_image[index, channel, at])
                        sums[index, channel] = sums[index, channel] + term
                    grad_alpha = wp.cw_mul(wp.cw_mul(t, q) - wp.cw_mul(r, inverse), contributes)
                    # None where alpha is clamped to its limit.
                    grad_alpha = wp.cw_mul(grad_alpha, heaviside(broadcast(real(ALPHA_MAX)) - unclamped))
                    # 1 where nothing contributes: a quotient by 0 would be no number.
                    safe = wp.cw_mul(forward - ones, contributes) + ones
                    slope = wp.cw_div(wp.cw_mul(alpha, grad_alpha), wp.cw_mul(safe, safe))
                    from_axis = wp.cw_mul(wp.cw_div(squared, safe), slope)
                    from_u = wp.cw_mul(slope, u)
                    from_v = wp.cw_mul(slope, v)
                    dx = row_directions[index, 0, at]
                    dy = row_directions[index, 1, at]
                    dz = row_directions[index, 2, at]
                    axis_x += wp.cw_mul(from_axis, dx)
                    axis_y += wp.cw_mul(from_axis, dy)
                    axis_z += wp.cw_mul(from_axis, dz)
                    across_x -= wp.cw_mul(from_u, dx)
                    across_y -= wp.cw_mul(from_u, dy)
                    across_z -= wp.cw_mul(from_u, dz)
                    along_x -= wp.cw_mul(from_v, dx)
                    along_y -= wp.cw_mul(from_v, dy)
                    along_z -= wp.cw_mul(from_v, dz)
                    from_opacity += wp.cw_mul(value, grad_alpha)
            target = emit_indices[k]
            grad_intersections[target, 0] = wp.dot(axis_x, ones)
            grad_intersections[target, 1] = wp.dot(axis_y, ones)
            grad_intersections[target, 2] = wp.dot(axis_z, ones)
            grad_intersections[target, 3] = wp.dot(across_x, ones)
            grad_intersections[target, 4] = wp.dot(across_y, ones)
            grad_intersections[target, 5] = wp.dot(across_z, ones)
            grad_intersections[target, 6] = wp.dot(along_x, ones)
            grad_intersections[target, 7] = wp.dot(along_y, ones)
            grad_intersections[target, 8] = wp.dot(along_z, ones)
            grad_intersections[target, 9] = wp.dot(from_opacity, ones)
            for channel in range(wp.static(channels)):
                grad_intersections[target, 10 + channel] = wp.dot(sums[index, channel], ones)

    return blend_backward
