"""The plane sweep of plane_sweep.py for the CPU: rows of 8 depths, of one pixel, which LLVM turns into AVX2.

Where a neighbor shows a pixel of the patch is linear in the depth, before the division: origin + depth * ray.
"""

import warp as wp

from .constants import FUSED, NO_AUTODIFF, cpu_flags
from .geometry import vector
from .plane_sweep import (
    LARGEST,
    MOST_NEIGHBORS,
    RADIUS,
    SIDE,
    SIMILARITY,
    WHITE,
    better_half,
    costs8,
    in_order,
    in_pixels,
)

LANES = 8
OPTIONS = NO_AUTODIFF | {"cpu_compiler_flags": cpu_flags() + FUSED, "max_unroll": 8}
PATCH = SIDE * SIDE

_row, _codes, _patch = vector(LANES, wp.float32), vector(LANES, wp.int32), vector(PATCH, wp.float32)
_costs = wp.types.matrix(shape=(MOST_NEIGHBORS, LANES), dtype=wp.float32)


@wp.func
def channel_of(code: int, channel: int) -> float:
    """Return a channel of packed codes, times 256^channel."""
    return float(code & (255 << (8 * channel)))


@wp.func
def channels_of(codes: _codes, channel: int) -> _row:
    """Return a channel of eight packed codes, times 256^channel.

    Without a shift, because LLVM would continue by packing bytes.
    """
    masked = codes & _codes(255 << (8 * channel))
    result = _row()
    for lane in range(wp.static(LANES)):
        result[lane] = float(masked[lane])
    return result


@wp.func
def codes_at(photos: wp.array(dtype=wp.int32), offset: wp.int64, indices: _row) -> _codes:
    """Return colors at indices of pixels, which floats represent exactly up to 16 million."""
    result = _codes()
    for lane in range(wp.static(LANES)):
        result[lane] = photos[offset + wp.int64(int(indices[lane]))]
    return result


@wp.func
def truncated(x: _row) -> _row:
    """Return the numbers of a row without their fractions."""
    result = _row()
    for lane in range(wp.static(LANES)):
        result[lane] = float(int(x[lane]))
    return result


@wp.func
def mixed(a: _row, b: _row, share: _row) -> _row:
    """Return a row between a (share 0) and b (share 1)."""
    return a + wp.cw_mul(b - a, share)


@wp.kernel(module="unique", module_options=OPTIONS)
def sweep_rows(
    range_start: int,
    photos: wp.array(dtype=wp.int32), offsets: wp.array(dtype=wp.int64), sizes: wp.array2d(dtype=wp.int32),
    intrinsics: wp.array(dtype=wp.vec4), neighbors: wp.array2d(dtype=wp.int32), between: wp.array2d(dtype=wp.mat44),
    pixels: wp.array2d(dtype=wp.int32), depths: wp.array2d(dtype=wp.float32),
    costs: wp.array2d(dtype=wp.float32),
):
    """Compute the costs of plane_sweep.sweep(); an index is one pixel and one row of depths, ceil(D / 8) for a pixel.

    photos: the four codes of a pixel in one number, red lowest.
    """
    i = range_start + wp.tid()
    count = depths.shape[1]
    rows = (count + wp.static(LANES - 1)) / wp.static(LANES)
    n = i / rows
    start = (i - n * rows) * wp.static(LANES)
    end = wp.min(start + wp.static(LANES), count)
    view, column, line = pixels[n, 0], pixels[n, 1], pixels[n, 2]
    width, own = sizes[view, 0], intrinsics[view]
    corner = offsets[view] + wp.int64((line - RADIUS) * width + column - RADIUS)
    depth = _row(depths[n, start])
    for d in range(start, end):
        depth[d - start] = depths[n, d]

    middle = photos[corner + wp.int64(RADIUS * width + RADIUS)]
    weights = _patch()
    total = float(0.0)
    for k in range(wp.static(PATCH)):
        y = k / wp.static(SIDE)
        code = photos[corner + wp.int64(y * width + k - y * wp.static(SIDE))]
        unlike = float(0.0)
        for channel in range(3):
            unlike += wp.abs(channel_of(code, channel) - channel_of(middle, channel)) / float(1 << (8 * channel))
        weights[k] = wp.exp(unlike * (-1.0 / (WHITE * SIMILARITY)))
        total += weights[k]
    total *= WHITE

    result = _costs()
    for slot in range(neighbors.shape[1]):
        result[slot] = _row(2.0 * LARGEST)
        other = neighbors[view, slot]
        if other >= 0:
            to_other, lens = between[view, slot], intrinsics[other]
            stride, offset = sizes[other, 0], offsets[other]
            # Less what rounding may take a pixel of the patch beyond its corners.
            right, bottom = float(stride - 1) - 1.0e-3, float(sizes[other, 1] - 1) - 1.0e-3
            origin = in_pixels(lens, wp.transform_point(to_other, wp.vec3(0.0, 0.0, 0.0)))
            across = in_pixels(lens, wp.transform_vector(to_other, wp.vec3(1.0 / own[0], 0.0, 0.0)))
            down = in_pixels(lens, wp.transform_vector(to_other, wp.vec3(0.0, 1.0 / own[1], 0.0)))
            u = (float(column - RADIUS) + 0.5 - own[2]) / own[0]
            v = (float(line - RADIUS) + 0.5 - own[3]) / own[1]
            ray = in_pixels(lens, wp.transform_vector(to_other, wp.vec3(u, v, 1.0)))
            # How far within the photo the patch's corners are.
            margin = _row(1.0)
            finite = _row()
            k = int(0)
            while k < 4:
                along = ray + float(k / 2 * wp.static(SIDE - 1)) * across + float(k % 2 * wp.static(SIDE - 1)) * down
                z = depth * along[2] + _row(origin[2])
                x_there = wp.cw_div(depth * along[0] + _row(origin[0]), z)
                y_there = wp.cw_div(depth * along[1] + _row(origin[1]), z)
                margin = wp.min(margin, wp.min(wp.min(x_there, _row(right) - x_there), _row(bottom) - y_there))
                margin = wp.min(margin, wp.min(y_there, z - depth * 1.0e-6))
                finite += (x_there + y_there) * 0.0
                k += 1
            margin += finite  # Minima pass over what is not a number; this sum becomes none.
            last_neighbor = int(-1)
            for lane in range(wp.static(LANES)):
                if margin[lane] >= 0.0:
                    last_neighbor = lane
            if last_neighbor >= 0:
                # Depths that the neighbor does not show are looked up where it shows another.
                safe = depth
                for lane in range(wp.static(LANES)):
                    if not margin[lane] >= 0.0:
                        safe[lane] = depth[last_neighbor]
                sums = _row()
                for k in range(wp.static(PATCH)):
                    y = k / wp.static(SIDE)
                    x = k - y * wp.static(SIDE)
                    along = ray + float(x) * across + float(y) * down
                    nearness = wp.cw_div(_row(1.0), safe * along[2] + _row(origin[2]))
                    x_there = wp.cw_mul(safe * along[0] + _row(origin[0]), nearness)
                    y_there = wp.cw_mul(safe * along[1] + _row(origin[1]), nearness)
                    left = truncated(x_there)
                    top = truncated(y_there)
                    a = x_there - left
                    b = y_there - top
                    indices = top * float(stride) + left
                    codes = codes_at(photos, offset, indices)
                    after = codes_at(photos, offset + wp.int64(1), indices)
                    below = codes_at(photos, offset + wp.int64(stride), indices)
                    below_after = codes_at(photos, offset + wp.int64(stride + 1), indices)
                    code = photos[corner + wp.int64(y * width + x)]
                    apart = _row()
                    for channel in range(3):
                        upper = mixed(channels_of(codes, channel), channels_of(after, channel), a)
                        lower = mixed(channels_of(below, channel), channels_of(below_after, channel), a)
                        unlike_here = wp.abs(mixed(upper, lower, b) - _row(channel_of(code, channel)))
                        apart += unlike_here * (1.0 / float(1 << (8 * channel)))
                    sums += wp.min(apart, _row(WHITE * LARGEST)) * weights[k]
                for lane in range(wp.static(LANES)):
                    if margin[lane] >= 0.0:
                        result[slot, lane] = sums[lane] / total

    for d in range(start, end):
        best = costs8()
        neighbor_count = int(0)
        for slot in range(neighbors.shape[1]):
            cost = result[slot, d - start]
            if cost < 2.0 * LARGEST:
                best = in_order(best, neighbor_count, cost)
                neighbor_count += 1
        costs[n, d] = better_half(best, neighbor_count)
