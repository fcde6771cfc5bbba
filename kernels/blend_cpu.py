"""N-channel front-to-back blend and its backward pass for the CPU: rows of 8 pixels, branch-free.

One kernel index is one tile of 16 x 16 pixels, in two halves side by side. For each Gaussian of the tile's list the
kernel walks the pixel rows that the Gaussian reaches, of the halves that it reaches. A row is one vector of 8, and
every decision (is alpha high enough, is the pixel finished) is a factor of 0 or 1, so that LLVM turns a row into a
handful of AVX2 instructions. The exponential is a polynomial for the same reason: a call of libm's expf would break the
vectorization.

Forward, per pixel, with T the transmittance so far:

    alpha = min(opacity exp(p), ALPHA_MAX),  counts if alpha > threshold and T (1 - alpha) > TRANSMITTANCE_MIN
    image += alpha T feature;  T *= 1 - alpha

A finished pixel stays finished. Its T is stored negated meanwhile, which saves a separate flag.

The backward pass walks the list back to front, from the last Gaussian that counts in each pixel, with two numbers of
state whatever the channel count: T, and R = the part of the loss's derivative that arrives from behind,

    R_last = T_last dL/dT;   T = T / (1 - alpha);   q = <feature, dL/dimage>
    dL/dalpha = T q - R / (1 - alpha);   R += alpha T q

Front to back, R would be formed by subtraction, which loses the dim Gaussians behind bright ones.

Each tile writes the gradients of its intersections, and `gather_intersections` sums a Gaussian's in a fixed order:
results do not depend on the number of threads.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from .constants import ALPHA_MAX, FUSED, NO_AUTODIFF, TILE_SIZE, TRANSMITTANCE_MIN, cpu_flags
from .geometry import vector

LANES = 8  # Pixels in a row: a register of AVX2. Rows of 16 are wider than most Gaussians
HALVES = TILE_SIZE // LANES

# exp(x) on [-0.7, 0] by falling powers, least squares in relative error at Chebyshev points: right to 8.1e-8.
EXP_COEFFICIENTS = (
    0.005842492519509847, 0.03976483434512436, 0.16596903052172265, 0.49988127666530136, 0.9999924147532289,
    0.9999999185311941,
)


class RowFunctions(NamedTuple):
    """Type of a row of LANES pixels, and Warp functions of such rows."""

    row: Any
    broadcast: Any  # A row of one value
    heaviside: Any  # 1 where a value is positive, else 0
    exponential: Any  # exp() of values that are not positive
    half_range: Any  # First half of a tile that a Gaussian reaches, and one past the last


@cache
def row_functions(dtype, exp_squarings: int) -> RowFunctions:
    """Return what both kernels do with rows of pixels.

    float64, the reference, uses the library's exponential. exp_squarings: the polynomial is evaluated at
    p / 2^exp_squarings and squared as often, so that p may go down to -0.7 * 2^exp_squarings.
    """
    row, vec4, real = vector(LANES, dtype), vector(4, dtype), dtype
    lowest = -0.7 * 2.0**exp_squarings
    highest, *others = EXP_COEFFICIENTS
    degree = len(others)
    # Not wp.static(others[k]): of a function that kernels share, the cache would take it for another one once it is
    # compiled.
    lower = vector(degree, dtype)(*others)

    @wp.func
    def broadcast(value: real) -> row:
        return row(value)

    @wp.func
    def heaviside(x: row) -> row:
        """Return 1 where x > 0, else 0; compiles to a compare."""
        return wp.min(wp.max(x * real(1.0e30), row(real(0.0))), row(real(1.0)))

    if dtype is wp.float64:

        @wp.func
        def exponential(p: row) -> row:
            e = row()
            for i in range(wp.static(LANES)):
                e[i] = wp.exp(p[i])
            return e

    else:

        @wp.func
        def exponential(p: row) -> row:
            x = wp.max(p, row(real(lowest))) * real(wp.static(0.5**exp_squarings))
            e = row(real(highest))
            for k in range(wp.static(degree)):
                e = wp.cw_mul(e, x) + row(lower[k])
            for _ in range(wp.static(exp_squarings)):
                e = wp.cw_mul(e, e)
            return e

    @wp.func
    def half_range(x: real, conic_cutoff: vec4) -> wp.vec2i:
        """Return the first half that is reached and one past the last; x: from the tile's first pixel to the center."""
        determinant = conic_cutoff[0] * conic_cutoff[2] - conic_cutoff[1] * conic_cutoff[1]
        reached = wp.vec2i(0, wp.static(HALVES))
        # For needles rounding leaves nothing of the determinant.
        if determinant > real(1.0e-4) * conic_cutoff[0] * conic_cutoff[2]:
            extent = wp.sqrt(conic_cutoff[3] * conic_cutoff[2] / determinant) * real(1.01) + real(0.01)
            first = wp.clamp((x - extent) * real(wp.static(1.0 / LANES)), real(0.0), real(wp.static(HALVES)))
            last = wp.clamp((x + extent) * real(wp.static(1.0 / LANES)), real(-1.0), real(wp.static(HALVES - 1)))
            reached = wp.vec2i(int(first), int(wp.floor(last)) + 1)
        return reached

    return RowFunctions(row, broadcast, heaviside, exponential, half_range)


def row_options(dtype) -> dict:
    """Return the options of modules whose kernels work on rows."""
    # Fusing multiply-adds is worth 1.3-1.6x here.
    fused = {"cpu_compiler_flags": cpu_flags() + FUSED} if dtype is wp.float32 else {}
    return NO_AUTODIFF | {"max_unroll": 64} | fused


@cache
def forward_kernel(dtype, channels: int, exp_squarings: int):
    """Return blend_forward(), launched over tiles from `range_start` on; see the module's description.

    exp_squarings: see row_functions().

    The kernel's arguments:
        tile_ranges: [tiles] first and one past the last intersection.
        gaussians: [M] the Gaussian of each intersection.
        means_opacities: [N] (x, y, opacity, half-height).
        conics_cutoffs: [N] (conic a, b, c, cutoff).
        features: [N, C].
        columns: tiles across.
        lane_offsets: one row, 0 to 7.
        tile_transmittance: scratch, [tiles, 32] rows, 16 a half.
        accumulated: scratch, [tiles, C, 32] rows.
        last_contributor: [tiles, 32] rows, 1 + list position of the last Gaussian that contributes.
        image: [H W, C].
        final_transmittance: [H W], of all Gaussians together.
    """
    row, broadcast, heaviside, exponential, half_range = row_functions(dtype, exp_squarings)
    real, vec4, size, lanes = dtype, vector(4, dtype), TILE_SIZE, LANES

    @wp.kernel(module="unique", module_options=row_options(dtype))
    def blend_forward(
        range_start: int,
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        means_opacities: wp.array(dtype=vec4), conics_cutoffs: wp.array(dtype=vec4), features: wp.array2d(dtype=real),
        columns: int, width: int, height: int, alpha_threshold: real,
        lane_offsets: wp.array(dtype=row), tile_transmittance: wp.array2d(dtype=row),
        accumulated: wp.array3d(dtype=row), last_contributor: wp.array2d(dtype=row),
        image: wp.array2d(dtype=real), final_transmittance: wp.array(dtype=real),
    ):
        tile = range_start + wp.tid()
        bounds = tile_ranges[tile]
        x0 = (tile % columns) * size
        y0 = (tile // columns) * size
        offsets = lane_offsets[0]
        # Not a constant of 32, which the compiler would take five times as long to write out.
        rows = tile_transmittance.shape[1]
        for j in range(rows):
            tile_transmittance[tile, j] = broadcast(real(1.0))
            last_contributor[tile, j] = broadcast(real(0.0))
            for channel in range(wp.static(channels)):
                accumulated[tile, channel, j] = broadcast(real(0.0))

        k = bounds[0]
        alive = bool(True)
        while k < bounds[1] and alive:
            i = gaussians[k]
            xy_opacity = means_opacities[i]
            conic_cutoff = conics_cutoffs[i]
            x = xy_opacity[0] - real(x0) - real(0.5)
            y = xy_opacity[1] - real(y0) - real(0.5)
            top = int(wp.max(wp.ceil(y - xy_opacity[3]), real(0.0)))
            bottom = int(wp.min(wp.floor(y + xy_opacity[3]), real(wp.static(size - 1)))) + 1
            reached = half_range(x, conic_cutoff)
            for half in range(reached[0], reached[1]):
                dx = broadcast(x - real(half * lanes)) - offsets
                in_x = wp.cw_mul(dx, dx) * (real(-0.5) * conic_cutoff[0])
                for j in range(top, bottom):
                    at = half * size + j
                    dy = y - real(j)
                    p = in_x + dx * (-conic_cutoff[1] * dy) + broadcast(real(-0.5) * conic_cutoff[2] * dy * dy)
                    a = wp.min(exponential(wp.min(p, broadcast(real(0.0)))) * xy_opacity[2], broadcast(real(ALPHA_MAX)))
                    t = tile_transmittance[tile, at]
                    eligible = wp.cw_mul(heaviside(a - broadcast(alpha_threshold)), heaviside(t))
                    weight = wp.cw_mul(wp.cw_mul(a, t), eligible)
                    goes_on = heaviside(t - weight - broadcast(real(TRANSMITTANCE_MIN)))
                    weight = wp.cw_mul(weight, goes_on)
                    # The pixel that this Gaussian finishes keeps its T, negated; finished ones have eligible = 0.
                    finished = eligible - wp.cw_mul(eligible, goes_on)
                    tile_transmittance[tile, at] = t - weight - wp.cw_mul(t, finished) * real(2.0)
                    contributes = wp.cw_mul(eligible, goes_on)
                    previous = last_contributor[tile, at]
                    change = broadcast(real(k - bounds[0] + 1)) - previous
                    last_contributor[tile, at] = previous + wp.cw_mul(contributes, change)
                    for channel in range(wp.static(channels)):
                        accumulated[tile, channel, at] = accumulated[tile, channel, at] + weight * features[i, channel]
            k += 1
            if (k - bounds[0]) % 32 == 0:
                most = broadcast(real(0.0))
                for j in range(rows):
                    most += wp.max(tile_transmittance[tile, j], broadcast(real(0.0)))
                alive = wp.dot(most, broadcast(real(1.0))) > real(0.0)

        for j in range(wp.min(size, height - y0)):
            for i in range(wp.min(size, width - x0)):
                pixel = (y0 + j) * width + x0 + i
                half = i // lanes
                at = half * size + j
                final_transmittance[pixel] = wp.abs(tile_transmittance[tile, at][i - half * lanes])
                for channel in range(wp.static(channels)):
                    image[pixel, channel] = accumulated[tile, channel, at][i - half * lanes]

    return blend_forward


@cache
def backward_kernel(dtype, channels: int, exp_squarings: int):
    """Return the backward pass of forward_kernel(), whose arguments it shares.

    Its other arguments:
        emit_indices: [M] index of each intersection in grad_intersections.
        last_contributor: as the forward kernel left it.
        grad_image: [H W, C].
        grad_transmittance: [H W].
        tile_transmittance: as the forward kernel left it; it is overwritten.
        grad_from_behind: scratch, [tiles, 32] rows.
        tile_grad_image: scratch, [tiles, C, 32] rows.
        weights, slopes: scratch, [tiles, 16] rows.
        sums: scratch, [tiles, C + 6] rows: gradients of features; sums of slopes times 1, dx, dy, dx dx, dx dy, dy dy.
        grad_intersections: [M, C + 6] in the order of emission: features, conic a b c, x, y, opacity.
    """
    row, broadcast, heaviside, exponential, half_range = row_functions(dtype, exp_squarings)
    real, vec4, size, lanes = dtype, vector(4, dtype), TILE_SIZE, LANES
    of_1, of_x, of_y, of_xx, of_xy, of_yy = range(channels, channels + 6)

    @wp.kernel(module="unique", module_options=row_options(dtype))
    def blend_backward(
        range_start: int,
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        emit_indices: wp.array(dtype=wp.int32),
        means_opacities: wp.array(dtype=vec4), conics_cutoffs: wp.array(dtype=vec4), features: wp.array2d(dtype=real),
        columns: int, width: int, height: int, alpha_threshold: real,
        lane_offsets: wp.array(dtype=row), last_contributor: wp.array2d(dtype=row), grad_image: wp.array2d(dtype=real),
        grad_transmittance: wp.array(dtype=real), tile_transmittance: wp.array2d(dtype=row),
        grad_from_behind: wp.array2d(dtype=row), tile_grad_image: wp.array3d(dtype=row), weights: wp.array2d(dtype=row),
        slopes: wp.array2d(dtype=row), sums: wp.array2d(dtype=row), grad_intersections: wp.array2d(dtype=real),
    ):
        tile = range_start + wp.tid()
        bounds = tile_ranges[tile]
        x0 = (tile % columns) * size
        y0 = (tile // columns) * size
        offsets = lane_offsets[0]
        ones = broadcast(real(1.0))
        furthest = broadcast(real(0.0))
        for at in range(tile_transmittance.shape[1]):  # As in the forward kernel.
            t = wp.max(tile_transmittance[tile, at], tile_transmittance[tile, at] * real(-1.0))
            tile_transmittance[tile, at] = t
            furthest = wp.max(furthest, last_contributor[tile, at])
            from_transmittance = broadcast(real(0.0))
            for channel in range(wp.static(channels)):
                tile_grad_image[tile, channel, at] = broadcast(real(0.0))
            half = at // size
            j = at - half * size
            if y0 + j < height:
                left = x0 + half * lanes
                for i in range(wp.min(lanes, width - left)):
                    pixel = (y0 + j) * width + left + i
                    from_transmittance[i] = grad_transmittance[pixel]
                    for channel in range(wp.static(channels)):
                        tile_grad_image[tile, channel, at][i] = grad_image[pixel, channel]
            grad_from_behind[tile, at] = wp.cw_mul(t, from_transmittance)

        blend_count = int(wp.max(furthest))
        for k in range(bounds[0] + blend_count, bounds[1]):
            for column in range(wp.static(channels + 6)):
                grad_intersections[emit_indices[k], column] = real(0.0)

        for step_back in range(blend_count):
            k = bounds[0] + blend_count - 1 - step_back
            i = gaussians[k]
            xy_opacity = means_opacities[i]
            conic_cutoff = conics_cutoffs[i]
            x = xy_opacity[0] - real(x0) - real(0.5)
            y = xy_opacity[1] - real(y0) - real(0.5)
            top = int(wp.max(wp.ceil(y - xy_opacity[3]), real(0.0)))
            bottom = int(wp.min(wp.floor(y + xy_opacity[3]), real(wp.static(size - 1)))) + 1
            order = broadcast(real(k - bounds[0]) + real(0.5))
            target = emit_indices[k]
            for column in range(wp.static(channels + 6)):
                sums[tile, column] = broadcast(real(0.0))
            reached = half_range(x, conic_cutoff)
            for half in range(reached[0], reached[1]):
                dx = broadcast(x - real(half * lanes)) - offsets
                in_x = wp.cw_mul(dx, dx) * (real(-0.5) * conic_cutoff[0])
                for j in range(top, bottom):
                    at = half * size + j
                    dy = y - real(j)
                    p = in_x + dx * (-conic_cutoff[1] * dy) + broadcast(real(-0.5) * conic_cutoff[2] * dy * dy)
                    unclamped = exponential(wp.min(p, broadcast(real(0.0)))) * xy_opacity[2]
                    a = wp.min(unclamped, broadcast(real(ALPHA_MAX)))
                    not_behind = heaviside(last_contributor[tile, at] - order)
                    contributes = wp.cw_mul(heaviside(a - broadcast(alpha_threshold)), not_behind)
                    inverse = wp.cw_div(ones, ones - a)
                    t = tile_transmittance[tile, at]
                    # As an addition: t * inverse would round each of many faint factors the same way.
                    t = t + wp.cw_mul(wp.cw_mul(t, wp.cw_mul(a, inverse)), contributes)
                    tile_transmittance[tile, at] = t
                    q = tile_grad_image[tile, 0, at] * features[i, 0]
                    for channel in range(1, wp.static(channels)):
                        q += tile_grad_image[tile, channel, at] * features[i, channel]
                    r = grad_from_behind[tile, at]
                    weight = wp.cw_mul(wp.cw_mul(a, t), contributes)
                    from_a = wp.cw_mul(wp.cw_mul(t, q) - wp.cw_mul(r, inverse), contributes)
                    grad_from_behind[tile, at] = r + wp.cw_mul(weight, q)
                    weights[tile, j] = weight
                    # alpha = opacity exp(p): the derivative by p is alpha's own, and 0 where alpha is clamped to
                    # its limit
                    slopes[tile, j] = wp.cw_mul(wp.cw_mul(a, from_a), heaviside(broadcast(real(ALPHA_MAX)) - unclamped))

                s0 = broadcast(real(0.0))
                sy = broadcast(real(0.0))
                syy = broadcast(real(0.0))
                for j in range(top, bottom):
                    dy = y - real(j)
                    slope = slopes[tile, j]
                    s0 += slope
                    sy += slope * dy
                    syy += slope * (dy * dy)
                # Through memory: a sum over a row in the same breath would keep LLVM from taking rows at once.
                for channel in range(wp.static(channels)):
                    total = sums[tile, channel]
                    for j in range(top, bottom):
                        total += wp.cw_mul(weights[tile, j], tile_grad_image[tile, channel, half * size + j])
                    sums[tile, channel] = total
                sx = wp.cw_mul(s0, dx)
                sums[tile, of_1] = sums[tile, of_1] + s0
                sums[tile, of_x] = sums[tile, of_x] + sx
                sums[tile, of_y] = sums[tile, of_y] + sy
                sums[tile, of_xx] = sums[tile, of_xx] + wp.cw_mul(sx, dx)
                sums[tile, of_xy] = sums[tile, of_xy] + wp.cw_mul(sy, dx)
                sums[tile, of_yy] = sums[tile, of_yy] + syy
            for channel in range(wp.static(channels)):
                grad_intersections[target, channel] = wp.dot(sums[tile, channel], ones)
            sum_0 = wp.dot(sums[tile, of_1], ones)
            sum_x = wp.dot(sums[tile, of_x], ones)
            sum_y = wp.dot(sums[tile, of_y], ones)
            sum_xx = wp.dot(sums[tile, of_xx], ones)
            sum_xy = wp.dot(sums[tile, of_xy], ones)
            sum_yy = wp.dot(sums[tile, of_yy], ones)
            grad_intersections[target, wp.static(channels)] = real(-0.5) * sum_xx
            grad_intersections[target, wp.static(channels + 1)] = -sum_xy
            grad_intersections[target, wp.static(channels + 2)] = real(-0.5) * sum_yy
            grad_intersections[target, wp.static(channels + 3)] = -(conic_cutoff[0] * sum_x + conic_cutoff[1] * sum_y)
            grad_intersections[target, wp.static(channels + 4)] = -(conic_cutoff[1] * sum_x + conic_cutoff[2] * sum_y)
            grad_intersections[target, wp.static(channels + 5)] = sum_0 / xy_opacity[2]

    return blend_backward
