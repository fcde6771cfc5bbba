"""N-channel front-to-back blend and its adjoint for the CPU: rows of 16 pixels, branch-free.

One kernel index is one tile of 16 x 16 pixels. For each Gaussian of the tile's list the kernel walks the pixel rows
that the Gaussian reaches; a row is one vector of 16, and every decision (is alpha high enough, is the pixel finished)
is a factor of 0 or 1, so that LLVM turns a row into a handful of AVX-512 or AVX2 instructions. The exponential is a
polynomial for the same reason: a call of libm's expf would break the vectorisation.

Forward, per pixel, with T the transmittance so far:

    alpha = min(opacity exp(p), ALPHA_MAX),  counted if alpha > threshold and T (1 - alpha) > TRANSMITTANCE_MIN
    image += alpha T feature;  T *= 1 - alpha

A finished pixel stays finished. Its T is stored negated meanwhile, which saves a separate flag.

The adjoint walks the list back to front, from the last counted Gaussian of each pixel, with two numbers of state
whatever the channel count: T, and R = the part of the loss's derivative that arrives from behind,

    R_last = T_last dL/dT;   T = T / (1 - alpha);   q = <feature, dL/dimage>
    dL/dalpha = T q - R / (1 - alpha);   R += alpha T q

Front to back, R would be formed by subtraction, which loses the dim Gaussians behind bright ones.

Each tile writes the gradients of its list entries to rows of their own, and `gather_entries` sums a Gaussian's rows in
a fixed order: results do not depend on the number of threads.
"""

from functools import cache

import warp as wp

from .constants import ALPHA_MAX, TILE_SIZE, TRANSMITTANCE_MIN
from .geometry import vector

# Inlining everything and fusing multiply-adds is worth 1.3-1.6x here. The flags go to Warp's own LLVM.
COMPILER_FLAGS = "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000 "
COMPILER_FLAGS += "-ffp-contract=fast"

# exp(x) on [-0.7, 0] by falling powers, least squares in relative error at Chebyshev points: right to 8.1e-8.
EXP_COEFFICIENTS = (
    0.005842492519509847, 0.03976483434512436, 0.16596903052172265, 0.49988127666530136, 0.9999924147532289,
    0.9999999185311941,
)


@cache
def row_functions(dtype, halvings: int):
    """The type of a row of 16, and on rows: broadcast, comparison with zero, exp. float64, the reference, uses the
    library's exponential.

    halvings: the polynomial is taken at p / 2^halvings and squared as often, so that p may go down to -0.7 2^halvings.
    """
    row, real = vector(TILE_SIZE, dtype), dtype
    lowest = -0.7 * 2.0**halvings
    highest, *others = EXP_COEFFICIENTS
    degree = len(others)

    @wp.func
    def spread(value: real) -> row:
        return row(value)

    @wp.func
    def step(x: row) -> row:
        """1 where x > 0, else 0; compiles to a compare."""
        return wp.min(wp.max(x * real(1.0e30), row(real(0.0))), row(real(1.0)))

    if dtype is wp.float64:

        @wp.func
        def exponential(p: row) -> row:
            e = row()
            for i in range(wp.static(TILE_SIZE)):
                e[i] = wp.exp(p[i])
            return e

    else:

        @wp.func
        def exponential(p: row) -> row:
            x = wp.max(p, row(real(lowest))) * real(wp.static(0.5**halvings))
            e = row(real(highest))
            for k in range(wp.static(degree)):
                e = wp.cw_mul(e, x) + row(real(wp.static(others[k])))
            for _ in range(wp.static(halvings)):
                e = wp.cw_mul(e, e)
            return e

    return row, spread, step, exponential


def _options(dtype) -> dict:
    flags = {"cpu_compiler_flags": COMPILER_FLAGS} if dtype is wp.float32 else {}
    return {"enable_backward": False, "max_unroll": 64, **flags}


@cache
def forward_kernel(dtype, channels: int, halvings: int):
    """blend_forward over tiles, from `first` on: see the module's description.

    halvings: see row_functions
    ranges: [tiles] first and one past the last entry; entries: [M] Gaussians
    shapes: [N] (x, y, opacity, half-height); ellipses: [N] (conic a, b, c, level); features: [N, C]
    columns: tiles across; width, height: of the image; iota: one row, 0 to 15
    transmittance, accumulated, last: scratch of [tiles, 16] rows, [tiles, C, 16] rows and [tiles, 16] rows
    image: [H W, C]; left_over: [H W], the transmittance behind everything
    """
    row, spread, step, exponential = row_functions(dtype, halvings)
    real, vec4, size = dtype, vector(4, dtype), TILE_SIZE

    @wp.kernel(module="unique", module_options=_options(dtype))
    def blend_forward(
        first: int,
        ranges: wp.array(dtype=wp.vec2i), entries: wp.array(dtype=wp.int32), shapes: wp.array(dtype=vec4),
        ellipses: wp.array(dtype=vec4), features: wp.array2d(dtype=real),
        columns: int, width: int, height: int, alpha_threshold: real,
        iota: wp.array(dtype=row), transmittance: wp.array2d(dtype=row), accumulated: wp.array3d(dtype=row),
        last: wp.array2d(dtype=row), image: wp.array2d(dtype=real), left_over: wp.array(dtype=real),
    ):
        tile = first + wp.tid()
        bounds = ranges[tile]
        x0 = (tile % columns) * size
        y0 = (tile // columns) * size
        offsets = iota[0]
        for j in range(size):
            transmittance[tile, j] = spread(real(1.0))
            last[tile, j] = spread(real(0.0))
            for channel in range(wp.static(channels)):
                accumulated[tile, channel, j] = spread(real(0.0))

        k = bounds[0]
        alive = bool(True)
        while k < bounds[1] and alive:
            i = entries[k]
            shape = shapes[i]
            ellipse = ellipses[i]
            dx = spread(shape[0] - real(x0) - real(0.5)) - offsets
            in_x = wp.cw_mul(dx, dx) * (real(-0.5) * ellipse[0])
            y = shape[1] - real(y0) - real(0.5)
            top = wp.max(int(wp.ceil(y - shape[3])), 0)
            bottom = wp.min(int(wp.floor(y + shape[3])) + 1, size)
            for j in range(top, bottom):
                dy = y - real(j)
                p = in_x + dx * (-ellipse[1] * dy) + spread(real(-0.5) * ellipse[2] * dy * dy)
                a = wp.min(exponential(wp.min(p, spread(real(0.0)))) * shape[2], spread(real(ALPHA_MAX)))
                t = transmittance[tile, j]
                counted = wp.cw_mul(step(a - spread(alpha_threshold)), step(t))
                weight = wp.cw_mul(wp.cw_mul(a, t), counted)
                goes_on = step(t - weight - spread(real(TRANSMITTANCE_MIN)))
                weight = wp.cw_mul(weight, goes_on)
                # The pixel that this Gaussian finishes keeps its T, negated; finished ones have counted = 0.
                finished = counted - wp.cw_mul(counted, goes_on)
                transmittance[tile, j] = t - weight - wp.cw_mul(t, finished) * real(2.0)
                drawn = wp.cw_mul(counted, goes_on)
                previous = last[tile, j]
                last[tile, j] = previous + wp.cw_mul(drawn, spread(real(k - bounds[0] + 1)) - previous)
                for channel in range(wp.static(channels)):
                    accumulated[tile, channel, j] = accumulated[tile, channel, j] + weight * features[i, channel]
            k += 1
            if (k - bounds[0]) % 32 == 0:
                most = transmittance[tile, 0]
                for j in range(1, size):
                    most = wp.max(most, transmittance[tile, j])
                alive = wp.max(most) > real(0.0)

        for j in range(wp.min(size, height - y0)):
            t = transmittance[tile, j]
            for i in range(wp.min(size, width - x0)):
                pixel = (y0 + j) * width + x0 + i
                left_over[pixel] = wp.abs(t[i])
                for channel in range(wp.static(channels)):
                    image[pixel, channel] = accumulated[tile, channel, j][i]

    return blend_forward


@cache
def backward_kernel(dtype, channels: int, halvings: int):
    """The adjoint of forward_kernel, whose arguments it shares.

    emission: [M] each entry's row in entry_gradients
    last: as the forward left it; image_gradient: [H W, C]; left_over_gradient: [H W]
    transmittance: as the forward left it, and used up
    behind, weights, slopes: scratch of [tiles, 16] rows; incoming: scratch of [tiles, C, 16] rows
    entry_gradients: [M, C + 6], in the order of emission: features, conic a b c, x, y, opacity
    """
    row, spread, step, exponential = row_functions(dtype, halvings)
    real, vec4, size = dtype, vector(4, dtype), TILE_SIZE

    @wp.kernel(module="unique", module_options=_options(dtype))
    def blend_backward(
        first: int,
        ranges: wp.array(dtype=wp.vec2i), entries: wp.array(dtype=wp.int32), emission: wp.array(dtype=wp.int32),
        shapes: wp.array(dtype=vec4), ellipses: wp.array(dtype=vec4), features: wp.array2d(dtype=real),
        columns: int, width: int, height: int, alpha_threshold: real,
        iota: wp.array(dtype=row), last: wp.array2d(dtype=row), image_gradient: wp.array2d(dtype=real),
        left_over_gradient: wp.array(dtype=real), transmittance: wp.array2d(dtype=row),
        behind: wp.array2d(dtype=row), incoming: wp.array3d(dtype=row), weights: wp.array2d(dtype=row),
        slopes: wp.array2d(dtype=row), entry_gradients: wp.array2d(dtype=real),
    ):
        tile = first + wp.tid()
        bounds = ranges[tile]
        x0 = (tile % columns) * size
        y0 = (tile // columns) * size
        offsets = iota[0]
        ones = spread(real(1.0))
        furthest = spread(real(0.0))
        for j in range(size):
            t = wp.max(transmittance[tile, j], transmittance[tile, j] * real(-1.0))
            transmittance[tile, j] = t
            furthest = wp.max(furthest, last[tile, j])
            from_left_over = spread(real(0.0))
            for channel in range(wp.static(channels)):
                incoming[tile, channel, j] = spread(real(0.0))
            if y0 + j < height:
                for i in range(wp.min(size, width - x0)):
                    pixel = (y0 + j) * width + x0 + i
                    from_left_over[i] = left_over_gradient[pixel]
                    for channel in range(wp.static(channels)):
                        incoming[tile, channel, j][i] = image_gradient[pixel, channel]
            behind[tile, j] = wp.cw_mul(t, from_left_over)

        drawn = int(wp.max(furthest))
        for k in range(bounds[0] + drawn, bounds[1]):
            for column in range(wp.static(channels + 6)):
                entry_gradients[emission[k], column] = real(0.0)

        for step_back in range(drawn):
            k = bounds[0] + drawn - 1 - step_back
            i = entries[k]
            shape = shapes[i]
            ellipse = ellipses[i]
            dx = spread(shape[0] - real(x0) - real(0.5)) - offsets
            dx2 = wp.cw_mul(dx, dx)
            in_x = dx2 * (real(-0.5) * ellipse[0])
            y = shape[1] - real(y0) - real(0.5)
            top = wp.max(int(wp.ceil(y - shape[3])), 0)
            bottom = wp.min(int(wp.floor(y + shape[3])) + 1, size)
            place = spread(real(k - bounds[0]) + real(0.5))
            for j in range(top, bottom):
                dy = y - real(j)
                p = in_x + dx * (-ellipse[1] * dy) + spread(real(-0.5) * ellipse[2] * dy * dy)
                unclamped = exponential(wp.min(p, spread(real(0.0)))) * shape[2]
                a = wp.min(unclamped, spread(real(ALPHA_MAX)))
                counted = wp.cw_mul(step(a - spread(alpha_threshold)), step(last[tile, j] - place))
                inverse = wp.cw_div(ones, ones - a)
                t = transmittance[tile, j]
                # As an addition: t * inverse would round each of many faint factors the same way.
                t = t + wp.cw_mul(wp.cw_mul(t, wp.cw_mul(a, inverse)), counted)
                transmittance[tile, j] = t
                q = incoming[tile, 0, j] * features[i, 0]
                for channel in range(1, wp.static(channels)):
                    q += incoming[tile, channel, j] * features[i, channel]
                r = behind[tile, j]
                weight = wp.cw_mul(wp.cw_mul(a, t), counted)
                from_a = wp.cw_mul(wp.cw_mul(t, q) - wp.cw_mul(r, inverse), counted)
                behind[tile, j] = r + wp.cw_mul(weight, q)
                weights[tile, j] = weight
                # alpha = opacity exp(p): the derivative by p is alpha's own, and none where alpha is held at its limit
                slopes[tile, j] = wp.cw_mul(wp.cw_mul(a, from_a), step(spread(real(ALPHA_MAX)) - unclamped))

            s0 = spread(real(0.0))
            sy = spread(real(0.0))
            syy = spread(real(0.0))
            for j in range(top, bottom):
                dy = y - real(j)
                slope = slopes[tile, j]
                s0 += slope
                sy += slope * dy
                syy += slope * (dy * dy)
            target = emission[k]
            for channel in range(wp.static(channels)):
                total = spread(real(0.0))
                for j in range(top, bottom):
                    total += wp.cw_mul(weights[tile, j], incoming[tile, channel, j])
                entry_gradients[target, channel] = wp.dot(total, ones)
            sum_0 = wp.dot(s0, ones)
            sum_x = wp.dot(s0, dx)
            sum_y = wp.dot(sy, ones)
            entry_gradients[target, wp.static(channels)] = real(-0.5) * wp.dot(s0, dx2)
            entry_gradients[target, wp.static(channels + 1)] = -wp.dot(sy, dx)
            entry_gradients[target, wp.static(channels + 2)] = real(-0.5) * wp.dot(syy, ones)
            entry_gradients[target, wp.static(channels + 3)] = -(ellipse[0] * sum_x + ellipse[1] * sum_y)
            entry_gradients[target, wp.static(channels + 4)] = -(ellipse[1] * sum_x + ellipse[2] * sum_y)
            entry_gradients[target, wp.static(channels + 5)] = sum_0 / shape[2]

    return blend_backward
