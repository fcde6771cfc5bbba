"""The adjoint of blend_cuda: one warp of 32 lanes owns 8 x 4 pixels of a tile.

The list is walked as blend_cuda walks it, but from the last Gaussian drawn, and each 32 survivors in two phases. First
a lane is a pixel: it walks the survivors back to front and writes (weight, slope) for each. Then a lane is a Gaussian:
it sums its 32 pixels with no exchange between lanes. The gradients leave through shared memory as whole rows, so that
the atomics of a warp fall on neighbouring addresses.
"""

from functools import cache

import warp as wp

from .blend_cuda import BLOCK_DIM, module_options, padded_channels
from .constants import ALPHA_MAX, TILE_SIZE
from .geometry import geometry, vector

BLOCKS_PER_TILE = (TILE_SIZE // 8) * (TILE_SIZE // 4)
ROWS = 4  # of pixels of one warp


@cache
def backward_kernel(dtype, channels: int, ordered: bool):
    """blend_backward over tiles x BLOCKS_PER_TILE x 32 threads.

    As blend_cuda.forward_kernel, and image_gradient: [H W] vectors of C; transmittance_gradient: [H W], or [0] for 0;
    rows: ROWS and gradient_count: C + 6, as arguments so that their loops stay loops;
    gradients: [N (C + 6)], flat rows (features, conic a b c, x, y, opacity), added to

    ordered: the same sums in the same order every time, by one launch over tiles x 32 threads for each `corner` of the
    BLOCKS_PER_TILE, within which a row of gradients has one writer. rows_of: [M] the row of each entry, gradients:
    [M (C + 6)], to be gathered by Gaussian. Unordered, neither is read: atomics add to the Gaussians' rows.
    """
    g = geometry(dtype)
    real, vec4 = g.real, g.vec4
    quads = padded_channels(channels) // 4
    vec_padded, vec_image = vector(4 * quads, dtype), vector(channels, dtype)
    gradient_columns = channels + 6
    staging_columns = gradient_columns + 1 - gradient_columns % 2  # odd, so that lanes fall on different banks
    blocks_across = TILE_SIZE // 8

    @wp.kernel(
        module="unique", enable_backward=False, launch_bounds=BLOCK_DIM, grid_stride=False,
        module_options=module_options(dtype),
    )
    def blend_backward(
        ranges: wp.array(dtype=wp.vec2i), entries: wp.array(dtype=wp.int32), shapes: wp.array(dtype=vec4),
        ellipses: wp.array(dtype=vec4), features: wp.array(dtype=vec4),
        columns: int, width: int, height: int, alpha_threshold: real,
        transmittance: wp.array(dtype=real), last: wp.array(dtype=wp.int32),
        image_gradient: wp.array(dtype=vec_image), transmittance_gradient: wp.array(dtype=real),
        rows: int, gradient_count: int, only_corner: int,
        rows_of: wp.array(dtype=wp.int32), gradients: wp.array(dtype=real),
    ):
        thread = wp.tid()
        block = thread >> 5
        lane = thread & 31
        if wp.static(ordered):
            tile = block
            corner = only_corner
        else:
            tile = block // wp.static(BLOCKS_PER_TILE)
            corner = block - tile * wp.static(BLOCKS_PER_TILE)
        tile_row = tile // columns
        left = (tile - tile_row * columns) * wp.static(TILE_SIZE) + (corner % wp.static(blocks_across)) * 8
        top = tile_row * wp.static(TILE_SIZE) + (corner // wp.static(blocks_across)) * 4
        px = left + (lane & 7)
        py = top + (lane >> 3)
        inside = px < width and py < height
        pixel = wp.min(py, height - 1) * width + wp.min(px, width - 1)
        x = real(px) + real(0.5)
        y = real(py) + real(0.5)
        corner_x = real(left) + real(0.5)
        corner_y = real(top) + real(0.5)

        begin = ranges[tile][0]
        drawn = int(0)
        if inside:
            drawn = last[pixel]
        most_drawn = wp.tile_max(wp.tile(drawn))
        count = most_drawn[0]
        t = transmittance[pixel]
        pixel_gradient = image_gradient[pixel]
        behind = real(0.0)
        if transmittance_gradient.shape[0] > 0:
            behind = t * transmittance_gradient[pixel]
        incoming = vec_padded()
        for channel in range(wp.static(channels)):
            incoming[channel] = pixel_gradient[channel]
        block_incoming = wp.tile(incoming, preserve_type=True)

        lanes_below = (wp.uint32(1) << wp.uint32(lane)) - wp.uint32(1)
        queue_shape = wp.tile_empty(shape=64, dtype=vec4, storage="shared")
        queue_ellipse = wp.tile_empty(shape=64, dtype=vec4, storage="shared")
        queue_entry = wp.tile_empty(shape=64, dtype=wp.vec2i, storage="shared")
        queue_features = wp.tile_empty(shape=wp.static(32 * quads), dtype=vec4, storage="shared")
        # (weight, slope) of two Gaussians for each of the 32 pixels; 33 columns keep lanes on different banks
        pixel_terms = wp.tile_empty(shape=wp.static(16 * 33), dtype=vec4, storage="shared")
        staging = wp.tile_empty(shape=(32, wp.static(staging_columns)), dtype=real, storage="shared")
        queued = int(0)

        rounds = (count + 31) // 32
        gaussian = entries[begin + wp.max(count - 1 - lane, 0)] if count > 0 else 0
        upcoming = entries[begin + wp.max(count - 33 - lane, 0)] if count > 0 else 0
        shape = shapes[gaussian]
        ellipse = ellipses[gaussian]
        for turn in range(rounds):
            place = count - 1 - (turn * 32 + lane)
            hit = place >= 0 and g.ellipse_meets_rectangle(
                shape[0], shape[1], ellipse[0], ellipse[1], ellipse[2], ellipse[3],
                corner_x, corner_y, real(7.0), real(3.0),
            )
            bit = wp.uint32(0)
            if hit:
                bit = wp.uint32(1) << wp.uint32(lane)
            votes = wp.tile_sum(wp.tile(bit))
            mask = votes[0]
            slot = queued + wp.bit_count(mask & lanes_below)
            wp.tile_scatter_masked(queue_shape, slot, shape, hit)
            wp.tile_scatter_masked(queue_ellipse, slot, ellipse, hit)
            wp.tile_scatter_masked(queue_entry, slot, wp.vec2i(gaussian, place), hit)
            queued += wp.bit_count(mask)
            gaussian = upcoming
            shape = shapes[gaussian]
            ellipse = ellipses[gaussian]
            upcoming = entries[begin + wp.max(place - 64, 0)]
            rest = int(0)
            if turn == rounds - 1:
                rest = 31
            while queued + rest >= 32 and queued > 0:
                ready = wp.min(queued, 32)
                fetched = vec_padded()
                for e in range(wp.static(quads)):
                    row = (e * 32 + lane) // wp.static(quads)
                    entry = wp.tile_extract(queue_entry, row)
                    if row < ready:
                        quad = features[entry[0] * wp.static(quads) + (e * 32 + lane) - row * wp.static(quads)]
                        fetched[e * 4] = quad[0]
                        fetched[e * 4 + 1] = quad[1]
                        fetched[e * 4 + 2] = quad[2]
                        fetched[e * 4 + 3] = quad[3]
                for e in range(wp.static(quads)):
                    wp.tile_scatter_masked(
                        queue_features, e * 32 + lane,
                        vec4(fetched[e * 4], fetched[e * 4 + 1], fetched[e * 4 + 2], fetched[e * 4 + 3]), True,
                    )

                # A lane is a pixel: two Gaussians a step, back to front.
                for pair in range((ready + 1) // 2):
                    j = pair * 2
                    s = wp.tile_extract(queue_shape, j)
                    q = wp.tile_extract(queue_ellipse, j)
                    entry = wp.tile_extract(queue_entry, j)
                    s2 = wp.tile_extract(queue_shape, j + 1)
                    q2 = wp.tile_extract(queue_ellipse, j + 1)
                    entry2 = wp.tile_extract(queue_entry, j + 1)
                    unclamped = s[2] * wp.exp(g.splat_exponent(q[0], q[1], q[2], s[0] - x, s[1] - y))
                    a = wp.min(real(ALPHA_MAX), unclamped)
                    draw = entry[1] < drawn and a > alpha_threshold
                    unclamped2 = s2[2] * wp.exp(g.splat_exponent(q2[0], q2[1], q2[2], s2[0] - x, s2[1] - y))
                    a2 = wp.min(real(ALPHA_MAX), unclamped2)
                    draw2 = j + 1 < ready and entry2[1] < drawn and a2 > alpha_threshold
                    weight = real(0.0)
                    slope = real(0.0)
                    weight2 = real(0.0)
                    slope2 = real(0.0)
                    if draw:
                        along = real(0.0)
                        for e in range(wp.static(quads)):
                            quad = wp.tile_extract(queue_features, j * wp.static(quads) + e)
                            for h in range(wp.static(4)):
                                along += quad[h] * incoming[e * 4 + h]
                        inverse = real(1.0) / (real(1.0) - a)
                        # t * inverse would round each of many faint factors the same way.
                        t += t * (a * inverse)
                        weight = a * t
                        if unclamped < real(ALPHA_MAX):
                            slope = a * (t * along - behind * inverse)
                        behind += weight * along
                    if draw2:
                        along = real(0.0)
                        for e in range(wp.static(quads)):
                            quad = wp.tile_extract(queue_features, (j + 1) * wp.static(quads) + e)
                            for h in range(wp.static(4)):
                                along += quad[h] * incoming[e * 4 + h]
                        inverse = real(1.0) / (real(1.0) - a2)
                        t += t * (a2 * inverse)
                        weight2 = a2 * t
                        if unclamped2 < real(ALPHA_MAX):
                            slope2 = a2 * (t * along - behind * inverse)
                        behind += weight2 * along
                    wp.tile_scatter_masked(pixel_terms, pair * 33 + lane, vec4(weight, slope, weight2, slope2), True)

                # A lane is a Gaussian: moments of the slope over the 32 pixels.
                s = wp.tile_extract(queue_shape, lane)
                q = wp.tile_extract(queue_ellipse, lane)
                is_second = (lane & 1) == 1
                base = (lane >> 1) * 33
                feature_sum = vec_padded()
                sum_0 = real(0.0)
                sum_x = real(0.0)
                sum_y = real(0.0)
                sum_xx = real(0.0)
                sum_xy = real(0.0)
                sum_yy = real(0.0)
                for line in range(rows):
                    dy = s[1] - (corner_y + real(line))
                    row_0 = real(0.0)
                    row_x = real(0.0)
                    row_xx = real(0.0)
                    for column in range(wp.static(8)):
                        at = line * 8 + column
                        terms = wp.tile_extract(pixel_terms, base + at)
                        pixel_weight = wp.where(is_second, terms[2], terms[0])
                        pixel_slope = wp.where(is_second, terms[3], terms[1])
                        from_pixel = wp.tile_extract(block_incoming, at)
                        dx = s[0] - (corner_x + real(at - line * 8))
                        slope_dx = pixel_slope * dx
                        row_0 += pixel_slope
                        row_x += slope_dx
                        row_xx += slope_dx * dx
                        for channel in range(wp.static(channels)):
                            feature_sum[channel] += pixel_weight * from_pixel[channel]
                    sum_0 += row_0
                    sum_x += row_x
                    sum_xx += row_xx
                    sum_xy += row_x * dy
                    sum_y += row_0 * dy
                    sum_yy += row_0 * dy * dy
                for channel in range(wp.static(channels)):
                    wp.tile_scatter_masked(staging, lane, channel, feature_sum[channel], True)
                wp.tile_scatter_masked(staging, lane, wp.static(channels), real(-0.5) * sum_xx, True)
                wp.tile_scatter_masked(staging, lane, wp.static(channels + 1), -sum_xy, True)
                wp.tile_scatter_masked(staging, lane, wp.static(channels + 2), real(-0.5) * sum_yy, True)
                wp.tile_scatter_masked(staging, lane, wp.static(channels + 3), -(q[0] * sum_x + q[1] * sum_y), True)
                wp.tile_scatter_masked(staging, lane, wp.static(channels + 4), -(q[1] * sum_x + q[2] * sum_y), True)
                wp.tile_scatter_masked(staging, lane, wp.static(channels + 5), sum_0 / s[2], True)
                for e in range(gradient_count):
                    flat = e * 32 + lane
                    owner = flat // wp.static(gradient_columns)
                    part = flat - owner * wp.static(gradient_columns)
                    entry = wp.tile_extract(queue_entry, owner)
                    value = wp.tile_extract(staging, owner, part)
                    if owner < ready:
                        if wp.static(ordered):
                            place_of = rows_of[begin + entry[1]] * wp.static(gradient_columns) + part
                            gradients[place_of] = gradients[place_of] + value
                        else:
                            wp.atomic_add(gradients, entry[0] * wp.static(gradient_columns) + part, value)

                queued = queued - ready
                keep = lane < queued
                late_shape = wp.tile_extract(queue_shape, 32 + lane)
                late_ellipse = wp.tile_extract(queue_ellipse, 32 + lane)
                late_entry = wp.tile_extract(queue_entry, 32 + lane)
                wp.tile_scatter_masked(queue_shape, lane, late_shape, keep)
                wp.tile_scatter_masked(queue_ellipse, lane, late_ellipse, keep)
                wp.tile_scatter_masked(queue_entry, lane, late_entry, keep)

    return blend_backward
