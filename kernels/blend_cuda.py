"""N-channel front-to-back blend for CUDA: one warp of 32 lanes owns a few pixels of a tile.

The maths is blend_cpu's; what differs is who does what. The adjoint is in blend_cuda_adjoint.py.

Both directions walk the tile's list 32 entries at a time. Each lane tests one entry's ellipse exactly against the
warp's rectangle of pixels, and the survivors are packed into a queue in shared memory; whenever 32 have gathered they
are blended. Most entries of a 16 x 16 tile miss an 8 x 8 or 8 x 4 corner of it, so most of the work is never done.
The features of the 32 survivors are fetched together, as rows of four.

Forward: a warp owns 8 x 8 pixels, two to a lane.

The queue is read by all lanes before it is overwritten; a vote or a scatter with its barrier always stands between.
These kernels also run on the CPU where wp.config.enable_cpu_blocks is set: slow, but the same logic, for tests.
"""

from functools import cache

import warp as wp

from .constants import ALPHA_MAX, TILE_SIZE, TRANSMITTANCE_MIN
from .geometry import geometry, vector

BLOCK_DIM = 32
BLOCKS_PER_TILE = (TILE_SIZE // 8) * (TILE_SIZE // 8)


def padded_channels(channels: int) -> int:
    """Feature rows are read four at a time."""
    return (channels + 3) // 4 * 4


def module_options(dtype) -> dict:
    """Approximate division and exponential in float32; float64 is the reference and never has them."""
    return {"fast_math": dtype is wp.float32, "max_unroll": 64, "enable_backward": False}


@cache
def forward_kernel(dtype, channels: int):
    """blend_forward over tiles x BLOCKS_PER_TILE x 32 threads.

    ranges: [tiles] first and one past the last entry; entries: [M] Gaussians; shapes: [N] (x, y, opacity, -);
    ellipses: [N] (conic a, b, c, level); features: [N padded_channels / 4] rows of four, flat
    image: [H W] vectors of C; transmittance: [H W]; last: [H W] 1 + list place of the last Gaussian drawn
    """
    g = geometry(dtype)
    real, vec4 = g.real, g.vec4
    quads = padded_channels(channels) // 4
    vec_padded, vec_image = vector(4 * quads, dtype), vector(channels, dtype)
    blocks_across = TILE_SIZE // 8

    @wp.kernel(
        module="unique", enable_backward=False, launch_bounds=BLOCK_DIM, grid_stride=False,
        module_options=module_options(dtype),
    )
    def blend_forward(
        ranges: wp.array(dtype=wp.vec2i), entries: wp.array(dtype=wp.int32), shapes: wp.array(dtype=vec4),
        ellipses: wp.array(dtype=vec4), features: wp.array(dtype=vec4),
        columns: int, width: int, height: int, alpha_threshold: real,
        image: wp.array(dtype=vec_image), transmittance: wp.array(dtype=real), last: wp.array(dtype=wp.int32),
    ):
        thread = wp.tid()
        block = thread >> 5
        lane = thread & 31
        tile = block // wp.static(BLOCKS_PER_TILE)
        corner = block - tile * wp.static(BLOCKS_PER_TILE)
        tile_row = tile // columns
        left = (tile - tile_row * columns) * wp.static(TILE_SIZE) + (corner % wp.static(blocks_across)) * 8
        top = tile_row * wp.static(TILE_SIZE) + (corner // wp.static(blocks_across)) * 8
        px = left + (lane & 7)
        py = top + (lane >> 3)
        upper_inside = px < width and py < height
        lower_inside = px < width and py + 4 < height
        x = real(px) + real(0.5)
        y = real(py) + real(0.5)
        corner_x = real(left) + real(0.5)
        corner_y = real(top) + real(0.5)

        # The lane's two pixels, four rows apart.
        upper_t = real(1.0)
        lower_t = real(1.0)
        upper_sum = vec_padded()
        lower_sum = vec_padded()
        upper_done = int(0)
        lower_done = int(0)
        upper_last = int(0)
        lower_last = int(0)
        if not upper_inside:
            upper_done = 1
        if not lower_inside:
            lower_done = 1

        bounds = ranges[tile]
        begin = bounds[0]
        count = bounds[1] - begin
        final = wp.max(count - 1, 0)
        lanes_below = (wp.uint32(1) << wp.uint32(lane)) - wp.uint32(1)
        queue_shape = wp.tile_empty(shape=64, dtype=vec4, storage="shared")
        queue_ellipse = wp.tile_empty(shape=64, dtype=vec4, storage="shared")
        queue_entry = wp.tile_empty(shape=64, dtype=wp.vec2i, storage="shared")
        queue_features = wp.tile_empty(shape=wp.static(32 * quads), dtype=vec4, storage="shared")
        queued = int(0)

        # Records are fetched one round ahead of their use.
        gaussian = int(0)
        upcoming = int(0)
        if count > 0:
            gaussian = entries[begin + wp.min(lane, final)]
            upcoming = entries[begin + wp.min(lane + 32, final)]
        shape = shapes[gaussian]
        ellipse = ellipses[gaussian]
        rounds = (count + 31) // 32
        turn = int(0)
        alive = int(1)
        while turn < rounds and alive == 1:
            place = turn * 32 + lane
            hit = place < count and g.ellipse_meets_rectangle(
                shape[0], shape[1], ellipse[0], ellipse[1], ellipse[2], ellipse[3],
                corner_x, corner_y, real(7.0), real(7.0),
            )
            bit = wp.uint32(0)
            if hit:
                bit = wp.uint32(1) << wp.uint32(lane)
            votes = wp.tile_sum(wp.tile(bit))
            mask = votes[0]
            slot = queued + wp.bit_count(mask & lanes_below)
            wp.tile_scatter_masked(queue_shape, slot, shape, hit)
            wp.tile_scatter_masked(queue_ellipse, slot, ellipse, hit)
            wp.tile_scatter_masked(queue_entry, slot, wp.vec2i(gaussian, place + 1), hit)
            queued += wp.bit_count(mask)
            turn += 1
            gaussian = upcoming
            shape = shapes[gaussian]
            ellipse = ellipses[gaussian]
            upcoming = entries[begin + wp.min(place + 64, final)]
            rest = int(0)
            if turn == rounds:
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
                for j in range(ready):
                    s = wp.tile_extract(queue_shape, j)
                    q = wp.tile_extract(queue_ellipse, j)
                    entry = wp.tile_extract(queue_entry, j)
                    dx = s[0] - x
                    dy = s[1] - y
                    upper_a = wp.min(real(ALPHA_MAX), s[2] * wp.exp(g.splat_exponent(q[0], q[1], q[2], dx, dy)))
                    upper_next = upper_t - upper_t * upper_a
                    draw = upper_done == 0 and upper_a > alpha_threshold
                    if draw and upper_next <= real(TRANSMITTANCE_MIN):
                        upper_done = 1
                        draw = False
                    upper_w = real(0.0)
                    if draw:
                        upper_w = upper_a * upper_t
                        upper_t = upper_next
                        upper_last = entry[1]
                    dy = dy - real(4.0)
                    lower_a = wp.min(real(ALPHA_MAX), s[2] * wp.exp(g.splat_exponent(q[0], q[1], q[2], dx, dy)))
                    lower_next = lower_t - lower_t * lower_a
                    draw = lower_done == 0 and lower_a > alpha_threshold
                    if draw and lower_next <= real(TRANSMITTANCE_MIN):
                        lower_done = 1
                        draw = False
                    lower_w = real(0.0)
                    if draw:
                        lower_w = lower_a * lower_t
                        lower_t = lower_next
                        lower_last = entry[1]
                    if upper_w + lower_w > real(0.0):
                        for e in range(wp.static(quads)):
                            quad = wp.tile_extract(queue_features, j * wp.static(quads) + e)
                            for h in range(wp.static(4)):
                                upper_sum[e * 4 + h] += quad[h] * upper_w
                                lower_sum[e * 4 + h] += quad[h] * lower_w
                done = wp.tile_sum(wp.tile(upper_done + lower_done))
                if done[0] == 64:
                    alive = 0
                queued = queued - ready
                keep = lane < queued
                late_shape = wp.tile_extract(queue_shape, 32 + lane)
                late_ellipse = wp.tile_extract(queue_ellipse, 32 + lane)
                late_entry = wp.tile_extract(queue_entry, 32 + lane)
                wp.tile_scatter_masked(queue_shape, lane, late_shape, keep)
                wp.tile_scatter_masked(queue_ellipse, lane, late_ellipse, keep)
                wp.tile_scatter_masked(queue_entry, lane, late_entry, keep)
                if alive == 0:
                    queued = 0

        upper_image = vec_image()
        lower_image = vec_image()
        for channel in range(wp.static(channels)):
            upper_image[channel] = upper_sum[channel]
            lower_image[channel] = lower_sum[channel]
        if upper_inside:
            pixel = py * width + px
            image[pixel] = upper_image
            transmittance[pixel] = upper_t
            last[pixel] = upper_last
        if lower_inside:
            pixel = (py + 4) * width + px
            image[pixel] = lower_image
            transmittance[pixel] = lower_t
            last[pixel] = lower_last

    return blend_forward
