"""The blend of sphere.py for the CPU: rows of 8 pixels, branch-free, as in blend_cpu.py.

One kernel index is one tile of 16 x 16 pixels. Of each Gaussian in the tile's list the kernel walks the rows whose cap
meets the Gaussian's.
"""

from functools import cache

import warp as wp

from .blend_cpu import HALVES, LANES, row_functions, row_options
from .constants import ALPHA_MAX, TILE_SIZE, TRANSMITTANCE_MIN
from .geometry import geometry

ROWS = HALVES * TILE_SIZE  # Rows of a tile, 16 of each half


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
    row, broadcast, heaviside, exponential, _ = row_functions(dtype, exp_squarings)
    g = geometry(dtype)
    real, vec3, vec4, size, lanes = g.real, g.vec3, g.vec4, TILE_SIZE, LANES
    cap_of_row = wp.types.vector(5, dtype)

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
            # Of pixels beyond the picture's border no direction is known, and 0 is in front of no Gaussian.
            dx = broadcast(real(0.0))
            dy = broadcast(real(0.0))
            dz = broadcast(real(0.0))
            mean = vec3()
            y = y0 + at % size
            for lane in range(wp.static(lanes)):
                x = x0 + (at // size) * lanes + lane
                if x < width and y < height:
                    d = directions[y * width + x]
                    dx[lane] = d[0]
                    dy[lane] = d[1]
                    dz[lane] = d[2]
                    mean += d
            row_directions[index, 0, at] = dx
            row_directions[index, 1, at] = dy
            row_directions[index, 2, at] = dz
            length = wp.length(mean)
            lowest = real(1.0)
            for lane in range(wp.static(lanes)):
                x = x0 + (at // size) * lanes + lane
                if x < width and y < height:
                    lowest = wp.min(lowest, wp.dot(mean, vec3(dx[lane], dy[lane], dz[lane])))
            # Directions that have no mean, as around a pole, or spread far: the cap is everything.
            cosine = real(-1.0)
            sine = real(0.0)
            if length > real(1.0e-3) and lowest > real(0.0):
                mean = mean / length
                # Rounding of a cosine near 1 is worth an angle of 3e-4.
                cosine = wp.max(lowest / length - real(1.0e-6), real(0.0))
                sine = wp.sqrt(real(1.0) - cosine * cosine)
            row_caps[index, at] = cap_of_row(mean[0], mean[1], mean[2], cosine, sine)

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
                cap_row = row_caps[index, at]
                meets = cap_row[3] < real(0.0)
                if not meets:
                    middle = cap[0] * cap_row[0] + cap[1] * cap_row[1] + cap[2] * cap_row[2]
                    meets = middle >= cosine * cap_row[3] - sine * cap_row[4] - real(1.0e-6)
                if meets:
                    dx = row_directions[index, 0, at]
                    dy = row_directions[index, 1, at]
                    dz = row_directions[index, 2, at]
                    forward = dx * cap[0] + dy * cap[1] + dz * cap[2]
                    u = dx * a[0] + dy * a[1] + dz * a[2]
                    v = dx * b[0] + dy * b[1] + dz * b[2]
                    squared = wp.cw_mul(u, u) + wp.cw_mul(v, v)
                    depth = wp.max(wp.cw_mul(forward, forward), broadcast(real(1.0e-30)))
                    p = wp.cw_div(squared, depth) * real(-0.5)
                    # As in falloff() of sphere.py: nothing behind the viewer, and nothing below exp(-18).
                    shown = wp.cw_mul(heaviside(forward), heaviside(p + broadcast(real(18.0))))
                    alpha = wp.min(exponential(p) * opacity, broadcast(real(ALPHA_MAX)))
                    t = tile_transmittance[index, at]
                    eligible = wp.cw_mul(heaviside(alpha - broadcast(alpha_threshold)), heaviside(t))
                    eligible = wp.cw_mul(eligible, shown)
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
