"""The backward pass of blend_cuda: one warp of 32 lanes owns 8 x 4 pixels of a tile.

A warp walks the list as in blend_cuda, but from the last Gaussian that contributes, and treats each batch of 32 that
touch its subtile in two phases. In the first a lane is a pixel: it walks the batch back to front and writes (weight,
slope) for each Gaussian. In the second a lane is a Gaussian: it sums its 32 pixels, without an exchange between lanes.
Gradients go through shared memory as whole rows, so that the atomics of a warp fall on neighboring addresses.
"""

from functools import cache

import warp as wp

from .blend_cuda import (
    BLOCK_DIM,
    BLOCKS_PER_TILE,
    QUEUE,
    ROUNDS,
    UNROLL,
    block_functions,
    module_options,
    padded_channels,
)
from .constants import ALPHA_MAX, NO_AUTODIFF, SUBTILE, TILE_SIZE
from .geometry import geometry, vector

LINES = 4  # Of pixels of one warp


ADD_QUAD = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<float4*>(numbers.data) + i, make_float4(a, b, c, d));
#elif defined(__CUDA_ARCH__)
    atomicAdd(numbers.data + 4 * i, a);
    atomicAdd(numbers.data + 4 * i + 1, b);
    atomicAdd(numbers.data + 4 * i + 2, c);
    atomicAdd(numbers.data + 4 * i + 3, d);
#endif
"""


@wp.func_native(ADD_QUAD)
def add_quad(numbers: wp.array(dtype=wp.float32), i: int, a: float, b: float, c: float, d: float):
    """Add to four numbers, from number 4 i on, on CUDA; by one access if the GPU can."""


def adds_quads(dtype, ordered: bool, cuda: bool) -> bool:
    """Return whether gradients are added four numbers at once; they then have a multiple of four columns."""
    return cuda and dtype is wp.float32 and not ordered


@cache
def copy_features_kernel(dtype):
    """Return copy_features() for one scalar type, launched over [N, C]."""

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def copy_features(gradients: wp.array2d(dtype=dtype), features: wp.array2d(dtype=dtype)):
        """Copy the first columns of gradients [N, C + 6 or more] to those of the features, [N, C]."""
        gaussian, channel = wp.tid()
        features[gaussian, channel] = gradients[gaussian, channel]

    return copy_features


@cache
def backward_kernel(dtype, channels: int, ordered: bool, cuda: bool = False):
    """Return blend_backward(), launched over tiles x BLOCKS_PER_TILE x 32 threads.

    ordered: the same sums in the same order every time, by one launch over tiles x 32 threads for each `only_subtile`
    of the BLOCKS_PER_TILE, within which each intersection has one writer. Unordered, atomics add to the Gaussians'.

    The kernel's arguments beside those of blend_cuda.forward_kernel():
        grad_image: [H W] vectors of C.
        grad_transmittance: [H W], or None for 0.
        lines: LINES; an argument, as the next, so that its loop stays a loop.
        gradient_count: C + 6.
        only_subtile: of an ordered launch; otherwise not read.
        emit_indices: [M] index of each intersection in the gradients, if ordered; otherwise not read.
        gradients: [N (C + 6)], flat (features, conic a b c, x, y, opacity), added to; if ordered, [M (C + 6)].
    """
    g = geometry(dtype)
    real, vec4 = g.real, g.vec4
    quads = padded_channels(channels) // 4
    vec_padded, vec_image, vec_many = vector(4 * quads, dtype), vector(channels, dtype), vector(UNROLL, dtype)
    vec_terms = vector(2 * UNROLL, dtype)
    vec_rounds = vector(ROUNDS, wp.int32)
    votes, read_quad = block_functions(dtype, cuda)
    gradient_columns = channels + 6
    staging_columns = gradient_columns + 1 - gradient_columns % 2  # odd, so that lanes fall on different banks
    blocks_across = TILE_SIZE // SUBTILE[0]
    by_quads = adds_quads(dtype, ordered, cuda)
    gradient_quads = padded_channels(gradient_columns) // 4
    vec_gradients = vector(4 * gradient_quads, dtype)

    @wp.kernel(
        module="unique", enable_backward=False, launch_bounds=BLOCK_DIM, grid_stride=False,
        module_options=module_options(dtype),
    )
    def blend_backward(
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        subtile_masks: wp.array(dtype=wp.uint8),
        means_opacities: wp.array(dtype=vec4), conics_cutoffs: wp.array(dtype=vec4), features: wp.array(dtype=vec4),
        columns: int, width: int, height: int, alpha_threshold: real,
        transmittance: wp.array(dtype=real), last_contributor: wp.array(dtype=wp.int32),
        grad_image: wp.array(dtype=vec_image), grad_transmittance: wp.array(dtype=real),
        lines: int, gradient_count: int, only_subtile: int,
        emit_indices: wp.array(dtype=wp.int32), gradients: wp.array(dtype=real),
    ):
        thread = wp.tid()
        block = thread >> 5
        lane = thread & 31
        if wp.static(ordered):
            tile = block
            subtile = only_subtile
        else:
            tile = block // wp.static(BLOCKS_PER_TILE)
            subtile = block - tile * wp.static(BLOCKS_PER_TILE)
        tile_row = tile // columns
        left = (tile - tile_row * columns) * wp.static(TILE_SIZE) + (subtile % wp.static(blocks_across)) * 8
        top = tile_row * wp.static(TILE_SIZE) + (subtile // wp.static(blocks_across)) * 4
        px = left + (lane & 7)
        py = top + (lane >> 3)
        inside = px < width and py < height
        pixel = wp.min(py, height - 1) * width + wp.min(px, width - 1)
        x = real(px) + real(0.5)
        y = real(py) + real(0.5)
        subtile_x = real(left) + real(0.5)
        subtile_y = real(top) + real(0.5)

        begin = tile_ranges[tile][0]
        own_last = int(0)
        if inside:
            own_last = last_contributor[pixel]
        furthest = wp.tile_max(wp.tile(own_last))
        count = furthest[0]
        last_position = real(own_last)
        t = transmittance[pixel]
        grad_pixel = grad_image[pixel]
        grad_from_behind = real(0.0)
        if grad_transmittance.shape[0] > 0:
            grad_from_behind = t * grad_transmittance[pixel]
        grad_channels = vec_padded()
        for channel in range(wp.static(channels)):
            grad_channels[channel] = grad_pixel[channel]
        block_grad_channels = wp.tile(grad_channels, preserve_type=True)

        lanes_below = (wp.uint32(1) << wp.uint32(lane)) - wp.uint32(1)
        queue = wp.tile_empty(shape=wp.static(QUEUE), dtype=wp.vec2i, storage="shared")
        batch_means = wp.tile_empty(shape=32, dtype=vec4, storage="shared")
        batch_conics = wp.tile_empty(shape=32, dtype=vec4, storage="shared")
        batch_features = wp.tile_empty(shape=wp.static(32 * quads), dtype=vec4, storage="shared")
        # (weight, slope) of two Gaussians for each of the 32 pixels; 33 columns keep lanes on different banks
        pixel_terms = wp.tile_empty(shape=wp.static(16 * 33), dtype=vec4, storage="shared")
        head = int(0)
        queued = int(0)
        ready = int(0)
        ready_one = wp.vec2i(0, 0)

        upcoming = vec_rounds()
        touched = vec_rounds()
        if count > 0:
            for k in range(wp.static(ROUNDS)):
                at = begin + wp.max(count - 1 - (k * 32 + lane), 0)
                upcoming[k] = gaussians[at]
                touched[k] = int(subtile_masks[at])
        turns = (count + wp.static(32 * ROUNDS - 1)) // wp.static(32 * ROUNDS)
        turn = int(0)
        alive = int(1)
        while alive == 1:
            while queued < 32 and turn < turns:
                start = count - 1 - (turn * wp.static(32 * ROUNDS) + lane)
                for k in range(wp.static(ROUNDS)):
                    position = start - k * 32
                    hit = position >= 0 and ((touched[k] >> subtile) & 1) == 1
                    mask = votes(hit, lane)
                    slot = (head + queued + wp.bit_count(mask & lanes_below)) & wp.static(QUEUE - 1)
                    wp.tile_scatter_masked(queue, slot, wp.vec2i(upcoming[k], position), hit)
                    queued += wp.bit_count(mask)
                turn += 1
                for k in range(wp.static(ROUNDS)):
                    at = begin + wp.max(start - wp.static(32 * ROUNDS) - k * 32, 0)
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

            if ready > 0:
                # A lane is a pixel: back to front, one that does not contribute with an alpha of 0.
                for group in range((ready + wp.static(UNROLL - 1)) // wp.static(UNROLL)):
                    alphas = vec_many()
                    gains = vec_many()
                    feature_dots = vec_many()
                    for k in range(wp.static(UNROLL)):
                        j = group * wp.static(UNROLL) + k
                        s = wp.tile_extract(batch_means, j)
                        q = wp.tile_extract(batch_conics, j)
                        dx = s[0] - x
                        dy = s[1] - y
                        unclamped = s[2] * wp.exp(wp.min(dx * (q[0] * dx + q[1] * dy) + q[2] * dy * dy, real(0.0)))
                        a = wp.min(real(ALPHA_MAX), unclamped)
                        contributes = s[3] < last_position and a > alpha_threshold
                        alphas[k] = wp.where(contributes, a, real(0.0))
                        gains[k] = wp.where(contributes and unclamped < real(ALPHA_MAX), a, real(0.0))
                        feature_dot = real(0.0)
                        for e in range(wp.static(quads)):
                            quad = wp.tile_extract(batch_features, j * wp.static(quads) + e)
                            for h in range(wp.static(4)):
                                feature_dot += quad[h] * grad_channels[e * 4 + h]
                        feature_dots[k] = feature_dot
                    own_terms = vec_terms()
                    for k in range(wp.static(UNROLL)):
                        a = alphas[k]
                        inverse = real(1.0) / (real(1.0) - a)
                        # t * inverse would round each of many faint factors the same way.
                        t += t * (a * inverse)
                        weight = a * t
                        own_terms[2 * k] = weight
                        own_terms[2 * k + 1] = gains[k] * (t * feature_dots[k] - grad_from_behind * inverse)
                        grad_from_behind += weight * feature_dots[k]
                    for k in range(wp.static(UNROLL // 2)):
                        wp.tile_scatter_masked(
                            pixel_terms, (group * wp.static(UNROLL // 2) + k) * 33 + lane,
                            vec4(own_terms[4 * k], own_terms[4 * k + 1], own_terms[4 * k + 2], own_terms[4 * k + 3]),
                            True,
                        )

                # A lane is a Gaussian: moments of the slope over the 32 pixels.
                s = wp.tile_extract(batch_means, lane)
                q = wp.tile_extract(batch_conics, lane)
                is_second = (lane & 1) == 1
                base = (lane >> 1) * 33
                feature_sum = vec_padded()
                sum_0 = real(0.0)
                sum_x = real(0.0)
                sum_y = real(0.0)
                sum_xx = real(0.0)
                sum_xy = real(0.0)
                sum_yy = real(0.0)
                for line in range(lines):
                    dy = s[1] - (subtile_y + real(line))
                    line_0 = real(0.0)
                    line_x = real(0.0)
                    line_xx = real(0.0)
                    for column in range(wp.static(8)):
                        at = line * 8 + column
                        terms = wp.tile_extract(pixel_terms, base + at)
                        pixel_weight = wp.where(is_second, terms[2], terms[0])
                        pixel_slope = wp.where(is_second, terms[3], terms[1])
                        from_pixel = wp.tile_extract(block_grad_channels, at)
                        dx = s[0] - (subtile_x + real(at - line * 8))
                        slope_dx = pixel_slope * dx
                        line_0 += pixel_slope
                        line_x += slope_dx
                        line_xx += slope_dx * dx
                        for channel in range(wp.static(channels)):
                            feature_sum[channel] += pixel_weight * from_pixel[channel]
                    sum_0 += line_0
                    sum_x += line_x
                    sum_xx += line_xx
                    sum_xy += line_x * dy
                    sum_y += line_0 * dy
                    sum_yy += line_0 * dy * dy
                sums = vec_gradients()
                for channel in range(wp.static(channels)):
                    sums[channel] = feature_sum[channel]
                sums[wp.static(channels)] = real(-0.5) * sum_xx
                sums[wp.static(channels + 1)] = -sum_xy
                sums[wp.static(channels + 2)] = real(-0.5) * sum_yy
                sums[wp.static(channels + 3)] = real(2.0) * q[0] * sum_x + q[1] * sum_y
                sums[wp.static(channels + 4)] = q[1] * sum_x + real(2.0) * q[2] * sum_y
                sums[wp.static(channels + 5)] = sum_0 / s[2]
                if wp.static(by_quads):
                    if lane < ready:
                        for e in range(wp.static(gradient_quads)):
                            add_quad(
                                gradients, ready_one[0] * wp.static(gradient_quads) + e,
                                sums[4 * e], sums[4 * e + 1], sums[4 * e + 2], sums[4 * e + 3],
                            )
                else:
                    owners = wp.tile(ready_one, preserve_type=True)
                    staging = wp.tile_empty(shape=(32, wp.static(staging_columns)), dtype=real, storage="shared")
                    for column in range(wp.static(gradient_columns)):
                        wp.tile_scatter_masked(staging, lane, column, sums[column], True)
                    for e in range(gradient_count):
                        flat = e * 32 + lane
                        owner = flat // wp.static(gradient_columns)
                        part = flat - owner * wp.static(gradient_columns)
                        entry = wp.tile_extract(owners, owner)
                        value = wp.tile_extract(staging, owner, part)
                        if owner < ready:
                            if wp.static(ordered):
                                index = emit_indices[begin + entry[1]] * wp.static(gradient_columns) + part
                                gradients[index] = gradients[index] + value
                            else:
                                wp.atomic_add(gradients, entry[0] * wp.static(gradient_columns) + part, value)

            if coming == 0:
                alive = 0
            ready = coming
            ready_one = own
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

    return blend_backward
