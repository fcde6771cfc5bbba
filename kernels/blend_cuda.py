"""N-channel front-to-back blend for CUDA: one warp of 32 lanes owns a subtile of a tile, 8 x 4 pixels.

The mathematics is that of blend_cpu; the division of work differs. The backward pass is in blend_cuda_backward.py.

Most intersections of a 16 x 16 tile miss an 8 x 4 subtile of it. `find_tile_ranges` of tiles.py tests the ellipse of
every intersection exactly against the subtiles of its tile, and sets a bit for each. A warp walks its tile's list 32
intersections at a time, ROUNDS of them together, and packs those that touch its subtile into a ring buffer in shared
memory. It blends them in batches of 32: each lane loads the mean, opacity, conic and features of one Gaussian, and then
each lane blends all 32 on its own pixel.

Lists differ in length by a factor of a hundred, and the longest ones decide the time of a picture, because a warp that
waits for memory does nothing else. Therefore the next rounds and the next batch are loaded while a batch is blended,
and the alphas of UNROLL Gaussians, which do not depend on each other, are computed without a branch before the first
of them is blended. Transmittance only falls, so one test after all of them finds whether it is still above its limit.

All lanes read a batch before it is overwritten, because a vote or a scatter with its barrier always lies between.
These kernels also run in Warp's CPU block emulation (wp.config.enable_cpu_blocks): slow, but the same logic, for tests.
"""

from functools import cache

import warp as wp

from .constants import ALPHA_MAX, SUBTILE, TILE_SIZE, TRANSMITTANCE_MIN
from .geometry import geometry, vector

BLOCK_DIM = 32
BLOCKS_PER_TILE = (TILE_SIZE // SUBTILE[0]) * (TILE_SIZE // SUBTILE[1])
UNROLL = 8  # Gaussians whose alphas are computed before the first of them is blended; divides 32
ROUNDS = 4  # Rounds of 32 intersections that are tested together
QUEUE = 64 * ROUNDS  # Slots of the ring buffer: at least 32 ROUNDS + 31, and a power of 2


def padded_channels(channels: int) -> int:
    """Return the next multiple of four: the columns of features that are read as quads, four numbers at once."""
    return (channels + 3) // 4 * 4


def module_options(dtype) -> dict:
    """Return options with approximate division and exponential in float32; float64, the reference, has exact ones."""
    return {"fast_math": dtype is wp.float32, "max_unroll": 64, "enable_backward": False}


BALLOT = """
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, vote);
#else
    return 0u;
#endif
"""
READ_QUAD = """
    const float4 four = reinterpret_cast<const float4*>(quads.data)[i];
    return wp::vec_t<4, wp::float32>(four.x, four.y, four.z, four.w);
"""


@wp.func_native(BALLOT)
def ballot(vote: bool, lane: int) -> wp.uint32:
    """Return the lanes of the warp whose vote is true, on CUDA."""


@cache
def block_functions(dtype, cuda: bool) -> tuple:
    """Return votes() and read_quad() for one scalar type.

    votes() is a word with a bit for each lane whose vote is true; read_quad() reads four numbers, on CUDA by one access
    if they are float32.
    """
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

        @wp.func_native(READ_QUAD)
        def read_quad(quads: wp.array(dtype=vec4), i: int) -> vec4: ...

    else:

        @wp.func
        def read_quad(quads: wp.array(dtype=vec4), i: int) -> vec4:
            return quads[i]

    return votes, read_quad


@cache
def forward_kernel(dtype, channels: int, cuda: bool = False):
    """Return blend_forward(), launched over tiles x BLOCKS_PER_TILE x 32 threads.

    cuda: False for Warp's CPU block emulation.

    The kernel's arguments:
        tile_ranges: [tiles] first and one past the last intersection.
        gaussians: [M] the Gaussian of each intersection.
        subtile_masks: [M] of find_tile_ranges().
        means_opacities: [N] (x, y, opacity, -).
        conics_cutoffs: [N] (conic a, b, c, cutoff).
        features: [N quads], padded to a multiple of four.
        columns: tiles across.
        image: [H W] vectors of C.
        transmittance: [H W].
        last_contributor: [H W], 1 + list position of the last Gaussian that contributes.
    """
    g = geometry(dtype)
    real, vec4 = g.real, g.vec4
    quads = padded_channels(channels) // 4
    vec_padded, vec_image, vec_many = vector(4 * quads, dtype), vector(channels, dtype), vector(UNROLL, dtype)
    vec_rounds = vector(ROUNDS, wp.int32)
    blocks_across = TILE_SIZE // SUBTILE[0]
    votes, read_quad = block_functions(dtype, cuda)

    @wp.kernel(
        module="unique", enable_backward=False, launch_bounds=BLOCK_DIM, grid_stride=False,
        module_options=module_options(dtype),
    )
    def blend_forward(
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        subtile_masks: wp.array(dtype=wp.uint8),
        means_opacities: wp.array(dtype=vec4), conics_cutoffs: wp.array(dtype=vec4), features: wp.array(dtype=vec4),
        columns: int, width: int, height: int, alpha_threshold: real,
        image: wp.array(dtype=vec_image), transmittance: wp.array(dtype=real),
        last_contributor: wp.array(dtype=wp.int32),
    ):
        thread = wp.tid()
        block = thread >> 5
        lane = thread & 31
        tile = block // wp.static(BLOCKS_PER_TILE)
        subtile = block - tile * wp.static(BLOCKS_PER_TILE)
        tile_row = tile // columns
        left = (tile - tile_row * columns) * wp.static(TILE_SIZE) + (subtile % wp.static(blocks_across)) * 8
        top = tile_row * wp.static(TILE_SIZE) + (subtile // wp.static(blocks_across)) * 4
        px = left + (lane & 7)
        py = top + (lane >> 3)
        inside = px < width and py < height
        x = real(px) + real(0.5)
        y = real(py) + real(0.5)

        t = real(1.0)
        active_threshold = wp.where(inside, alpha_threshold, real(wp.inf))
        last_position = real(0.0)
        sums = vec_padded()

        bounds = tile_ranges[tile]
        begin = bounds[0]
        count = bounds[1] - begin
        final = wp.max(count - 1, 0)
        lanes_below = (wp.uint32(1) << wp.uint32(lane)) - wp.uint32(1)
        queue = wp.tile_empty(shape=wp.static(QUEUE), dtype=wp.vec2i, storage="shared")
        batch_means = wp.tile_empty(shape=32, dtype=vec4, storage="shared")
        batch_conics = wp.tile_empty(shape=32, dtype=vec4, storage="shared")
        batch_features = wp.tile_empty(shape=wp.static(32 * quads), dtype=vec4, storage="shared")
        head = int(0)
        queued = int(0)
        ready = int(0)

        upcoming = vec_rounds()
        touched = vec_rounds()
        if count > 0:
            for k in range(wp.static(ROUNDS)):
                at = begin + wp.min(k * 32 + lane, final)
                upcoming[k] = gaussians[at]
                touched[k] = int(subtile_masks[at])
        turns = (count + wp.static(32 * ROUNDS - 1)) // wp.static(32 * ROUNDS)
        turn = int(0)
        alive = int(1)
        while alive == 1:
            while queued < 32 and turn < turns:
                start = turn * wp.static(32 * ROUNDS) + lane
                for k in range(wp.static(ROUNDS)):
                    position = start + k * 32
                    hit = position < count and ((touched[k] >> subtile) & 1) == 1
                    mask = votes(hit, lane)
                    slot = (head + queued + wp.bit_count(mask & lanes_below)) & wp.static(QUEUE - 1)
                    wp.tile_scatter_masked(queue, slot, wp.vec2i(upcoming[k], position + 1), hit)
                    queued += wp.bit_count(mask)
                turn += 1
                for k in range(wp.static(ROUNDS)):
                    at = begin + wp.min(start + wp.static(32 * ROUNDS) + k * 32, final)
                    upcoming[k] = gaussians[at]
                    touched[k] = int(subtile_masks[at])
            coming = wp.min(queued, 32)
            own = wp.tile_extract(queue, (head + lane) & wp.static(QUEUE - 1))
            xy_opacity = vec4()
            conic_cutoff = vec4()
            fetched = vec_padded()
            if lane < coming:
                xy_opacity = read_quad(means_opacities, own[0])
                conic_cutoff = read_quad(conics_cutoffs, own[0])
                for e in range(wp.static(quads)):
                    quad = read_quad(features, own[0] * wp.static(quads) + e)
                    for h in range(wp.static(4)):
                        fetched[e * 4 + h] = quad[h]
            head = (head + coming) & wp.static(QUEUE - 1)
            queued = queued - coming
            # The batch that was fetched before
            for group in range((ready + wp.static(UNROLL - 1)) // wp.static(UNROLL)):
                alphas = vec_many()
                positions = vec_many()
                for k in range(wp.static(UNROLL)):
                    j = group * wp.static(UNROLL) + k
                    s = wp.tile_extract(batch_means, j)
                    q = wp.tile_extract(batch_conics, j)
                    dx = s[0] - x
                    dy = s[1] - y
                    a = s[2] * wp.exp(wp.min(dx * (q[0] * dx + q[1] * dy) + q[2] * dy * dy, real(0.0)))
                    a = wp.min(real(ALPHA_MAX), a)
                    alphas[k] = wp.where(a > active_threshold, a, real(0.0))
                    positions[k] = s[3]
                following = real(t)
                for k in range(wp.static(UNROLL)):
                    weight = alphas[k] * following
                    following = following - weight
                    on = following > real(TRANSMITTANCE_MIN)
                    last_position = wp.where(on and alphas[k] > real(0.0), positions[k], last_position)
                    t = wp.where(on, following, t)
                    alphas[k] = wp.where(on, weight, real(0.0))
                active_threshold = wp.where(following > real(TRANSMITTANCE_MIN), active_threshold, real(wp.inf))
                for k in range(wp.static(UNROLL)):
                    for e in range(wp.static(quads)):
                        at = (group * wp.static(UNROLL) + k) * wp.static(quads) + e
                        quad = wp.tile_extract(batch_features, at)
                        for h in range(wp.static(4)):
                            sums[e * 4 + h] += quad[h] * alphas[k]
            # All have read the batch before it is overwritten.
            if votes(active_threshold < real(1.0), lane) == wp.uint32(0) or coming == 0:
                alive = 0
            ready = coming
            wp.tile_scatter_masked(
                batch_means, lane, vec4(xy_opacity[0], xy_opacity[1], xy_opacity[2], real(own[1])), True,
            )
            # Staged as -a / 2, -b, -c / 2, so that the exponent is dx (q0 dx + q1 dy) + q2 dy dy.
            wp.tile_scatter_masked(
                batch_conics, lane,
                vec4(real(-0.5) * conic_cutoff[0], -conic_cutoff[1], real(-0.5) * conic_cutoff[2], real(0.0)), True,
            )
            for e in range(wp.static(quads)):
                wp.tile_scatter_masked(
                    batch_features, lane * wp.static(quads) + e,
                    vec4(fetched[e * 4], fetched[e * 4 + 1], fetched[e * 4 + 2], fetched[e * 4 + 3]), True,
                )

        if inside:
            pixel = py * width + px
            colors = vec_image()
            for channel in range(wp.static(channels)):
                colors[channel] = sums[channel]
            image[pixel] = colors
            transmittance[pixel] = t
            last_contributor[pixel] = int(last_position)

    return blend_forward
