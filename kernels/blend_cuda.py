"""N-channel front-to-back blend for CUDA: one warp of 32 lanes owns 8 x 4 pixels of a tile.

The maths is blend_cpu's; what differs is who does what. The adjoint is in blend_cuda_adjoint.py.

Both directions walk the tile's list 32 entries at a time, a lane for each of 8 x 4 pixels. Each lane tests one entry's
ellipse exactly against the warp's rectangle of pixels, and the survivors are packed into a queue in shared memory, a
ring; whenever 32 have gathered they are blended. Most entries of a 16 x 16 tile miss an 8 x 4 corner of it, so most of
the work is never done. The features of the 32 survivors are fetched together, as rows of four.

A warp that waits for a result that it has just asked for does nothing else, and a small picture has few warps. So the
alphas of TOGETHER Gaussians, which depend on nothing, are worked out before the first is drawn, without a branch.

The queue is read by all lanes before it is overwritten; a vote or a scatter with its barrier always stands between.
These kernels also run on the CPU where wp.config.enable_cpu_blocks is set: slow, but the same logic, for tests.
"""

from functools import cache

import warp as wp

from .constants import ALPHA_MAX, TILE_SIZE, TRANSMITTANCE_MIN
from .geometry import geometry, vector

BLOCK_DIM = 32
BLOCKS_PER_TILE = (TILE_SIZE // 8) * (TILE_SIZE // 4)
TOGETHER = 4  # Gaussians whose alphas are worked out before the first of them is drawn; divides 32


def padded_channels(channels: int) -> int:
    """Feature rows are read four at a time."""
    return (channels + 3) // 4 * 4


def module_options(dtype) -> dict:
    """Approximate division and exponential in float32; float64 is the reference and never has them."""
    return {"fast_math": dtype is wp.float32, "max_unroll": 64, "enable_backward": False}


BALLOT = """
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, vote);
#else
    return 0u;
#endif
"""
ROW = """
    const float4 four = reinterpret_cast<const float4*>(rows.data)[i];
    return wp::vec_t<4, wp::float32>(four.x, four.y, four.z, four.w);
"""


@wp.func_native(BALLOT)
def ballot(vote: bool, lane: int) -> wp.uint32:
    """The lanes of the warp whose vote is true, on CUDA."""


@cache
def block_functions(dtype, cuda: bool) -> tuple:
    """For one scalar type, votes(): a word with a bit for each lane whose vote is true; row(): a row of four numbers,
    on CUDA by one access where numbers are float32."""
    vec4 = geometry(dtype).vec4

    if cuda:
        votes = ballot
    else:

        @wp.func
        def votes(vote: bool, lane: int) -> wp.uint32:
            bit = wp.uint32(0)
            if vote:
                bit = wp.uint32(1) << wp.uint32(lane)
            total = wp.tile_sum(wp.tile(bit))
            return total[0]

    if dtype is wp.float32 and cuda:

        @wp.func_native(ROW)
        def row(rows: wp.array(dtype=vec4), i: int) -> vec4: ...

    else:

        @wp.func
        def row(rows: wp.array(dtype=vec4), i: int) -> vec4:
            return rows[i]

    return votes, row


@cache
def forward_kernel(dtype, channels: int, cuda: bool = False):
    """blend_forward over tiles x BLOCKS_PER_TILE x 32 threads. cuda: not to run on the CPU's fibers.

    ranges: [tiles] first and one past the last entry; entries: [M] Gaussians; shapes: [N] (x, y, opacity, -);
    ellipses: [N] (conic a, b, c, level); features: [N padded_channels / 4] rows of four, flat
    image: [H W] vectors of C; transmittance: [H W]; last: [H W] 1 + list place of the last Gaussian drawn
    """
    g = geometry(dtype)
    real, vec4 = g.real, g.vec4
    quads = padded_channels(channels) // 4
    vec_padded, vec_image, vec_many = vector(4 * quads, dtype), vector(channels, dtype), vector(TOGETHER, dtype)
    blocks_across = TILE_SIZE // 8
    votes, row = block_functions(dtype, cuda)

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
        top = tile_row * wp.static(TILE_SIZE) + (corner // wp.static(blocks_across)) * 4
        px = left + (lane & 7)
        py = top + (lane >> 3)
        inside = px < width and py < height
        x = real(px) + real(0.5)
        y = real(py) + real(0.5)
        corner_x = real(left) + real(0.5)
        corner_y = real(top) + real(0.5)

        t = real(1.0)
        # What an alpha must exceed: nothing does where nothing more is drawn.
        bar = wp.where(inside, alpha_threshold, real(wp.inf))
        drawn = int(0)
        sums = vec_padded()

        bounds = ranges[tile]
        begin = bounds[0]
        count = bounds[1] - begin
        final = wp.max(count - 1, 0)
        lanes_below = (wp.uint32(1) << wp.uint32(lane)) - wp.uint32(1)
        queue_shape = wp.tile_empty(shape=64, dtype=vec4, storage="shared")
        queue_ellipse = wp.tile_empty(shape=64, dtype=vec4, storage="shared")
        queue_entry = wp.tile_empty(shape=64, dtype=wp.vec2i, storage="shared")
        queue_features = wp.tile_empty(shape=wp.static(32 * quads), dtype=vec4, storage="shared")
        head = int(0)
        queued = int(0)

        # Records are fetched one round ahead of their use.
        gaussian = int(0)
        upcoming = int(0)
        shape = vec4()
        ellipse = vec4()
        if count > 0:
            gaussian = entries[begin + wp.min(lane, final)]
            upcoming = entries[begin + wp.min(lane + 32, final)]
            shape = row(shapes, gaussian)
            ellipse = row(ellipses, gaussian)
        rounds = (count + 31) // 32
        turn = int(0)
        alive = int(1)
        while turn < rounds and alive == 1:
            place = turn * 32 + lane
            hit = place < count and g.ellipse_meets_rectangle(
                shape[0], shape[1], ellipse[0], ellipse[1], ellipse[2], ellipse[3],
                corner_x, corner_y, real(7.0), real(3.0),
            )
            mask = votes(hit, lane)
            slot = (head + queued + wp.bit_count(mask & lanes_below)) & 63
            wp.tile_scatter_masked(queue_shape, slot, shape, hit)
            wp.tile_scatter_masked(queue_ellipse, slot, ellipse, hit)
            wp.tile_scatter_masked(queue_entry, slot, wp.vec2i(gaussian, place + 1), hit)
            queued += wp.bit_count(mask)
            turn += 1
            gaussian = upcoming
            shape = row(shapes, gaussian)
            ellipse = row(ellipses, gaussian)
            upcoming = entries[begin + wp.min(place + 64, final)]
            rest = int(0)
            if turn == rounds:
                rest = 31
            while queued + rest >= 32 and queued > 0:
                ready = wp.min(queued, 32)
                fetched = vec_padded()
                for e in range(wp.static(quads)):
                    owner = (e * 32 + lane) // wp.static(quads)
                    entry = wp.tile_extract(queue_entry, head + owner)
                    if owner < ready:
                        quad = row(features, entry[0] * wp.static(quads) + (e * 32 + lane) - owner * wp.static(quads))
                        for h in range(wp.static(4)):
                            fetched[e * 4 + h] = quad[h]
                for e in range(wp.static(quads)):
                    wp.tile_scatter_masked(
                        queue_features, e * 32 + lane,
                        vec4(fetched[e * 4], fetched[e * 4 + 1], fetched[e * 4 + 2], fetched[e * 4 + 3]), True,
                    )
                for group in range((ready + wp.static(TOGETHER - 1)) // wp.static(TOGETHER)):
                    alphas = vec_many()
                    weights = vec_many()
                    for k in range(wp.static(TOGETHER)):
                        j = group * wp.static(TOGETHER) + k
                        s = wp.tile_extract(queue_shape, head + j)
                        q = wp.tile_extract(queue_ellipse, head + j)
                        a = s[2] * wp.exp(g.splat_exponent(q[0], q[1], q[2], s[0] - x, s[1] - y))
                        # Rows of the queue that hold nothing yet hold anything.
                        alphas[k] = wp.where(j < ready, wp.min(real(ALPHA_MAX), a), real(0.0))
                    for k in range(wp.static(TOGETHER)):
                        entry = wp.tile_extract(queue_entry, head + group * wp.static(TOGETHER) + k)
                        weight = alphas[k] * t
                        following = t - weight
                        draw = alphas[k] > bar
                        if draw and following <= real(TRANSMITTANCE_MIN):
                            bar = real(wp.inf)
                            draw = False
                        weights[k] = wp.where(draw, weight, real(0.0))
                        t = wp.where(draw, following, t)
                        drawn = wp.where(draw, entry[1], drawn)
                    for k in range(wp.static(TOGETHER)):
                        for e in range(wp.static(quads)):
                            at = (group * wp.static(TOGETHER) + k) * wp.static(quads) + e
                            quad = wp.tile_extract(queue_features, at)
                            for h in range(wp.static(4)):
                                sums[e * 4 + h] += quad[h] * weights[k]
                head = (head + 32) & 63
                queued = queued - ready
                if votes(bar < real(1.0), lane) == wp.uint32(0):
                    alive = 0
                    queued = 0

        if inside:
            pixel = py * width + px
            colors = vec_image()
            for channel in range(wp.static(channels)):
                colors[channel] = sums[channel]
            image[pixel] = colors
            transmittance[pixel] = t
            last[pixel] = drawn

    return blend_forward
