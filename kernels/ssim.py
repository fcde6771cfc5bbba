"""Structural similarity (Wang et al. 2004) and its adjoint: separable Gaussian windows over two images.

Written in the sum s = a + b and the difference d = a - b, whose windowed moments give

    SSIM = (1 - m_d^2 / ((m_s^2 + m_d^2) / 2 + C1)) (1 - v_d / ((v_s + v_d) / 2 + C2)),   v = E[x^2] - E[x]^2

which equals the usual quotient. It needs four blurs in place of five, and both factors are one minus something small:
near-identical images lose no digits, however bright they are.

A row of the image is one run of W C numbers, channel fastest, so that a step of one pixel is a shift by C numbers and
every kernel works on `lanes` neighbouring numbers at once: 16 on the CPU, whose serial loop LLVM then turns into SIMD,
and one on the GPU, whose threads take several rows or pixels instead. Arrays of runs are overlapping views: element
[y, i] holds the numbers i .. i + lanes - 1 of row y. Rows blurred vertically carry RADIUS pixels of zeros on both sides
(zero padding, as in 3DGS).
"""

from functools import cache
from math import exp
from types import SimpleNamespace

import warp as wp

from .constants import FORWARD
from .geometry import vector

RADIUS = 5
SIGMA = 1.5
STRIP = 8  # Rows or pixels side by side that a thread of a GPU takes: it reads 2 RADIUS beside, as it would for one
# (0.01 L)^2 and (0.03 L)^2 for the data range L = 1.
C1 = 0.01**2
C2 = 0.03**2


def window() -> list[float]:
    """The 2 RADIUS + 1 weights of the Gaussian window; they sum to one."""
    weights = [exp(-((i - RADIUS) ** 2) / (2.0 * SIGMA**2)) for i in range(2 * RADIUS + 1)]
    return [weight / sum(weights) for weight in weights]


@cache
def ssim_kernels(dtype, lanes: int, distance: bool = False) -> SimpleNamespace:
    """The four passes for one scalar type (wp.float32 or wp.float64); images need W C >= lanes.

    blur_columns, then compare: the SSIM map and its derivatives by the four windowed moments, combined for `a`.
    blur_derivatives, then gradient: the adjoint of the blurs, applied to those derivatives.

    A launch covers [0, rows * blocks) with blocks = ceil(W C / lanes). With one lane all but compare, which writes too
    much for that, take STRIP rows or pixels a thread: gradient covers [0, rows * ceil(W / STRIP) * C); the vertical
    blurs, which write the zeros on both sides too, [0, ceil(rows / STRIP) * (W C + 2 RADIUS C)), blur_derivatives that
    for each of its three planes.
    distance: for a weighted sum of |a - b| and 1 - SSIM in place of the SSIM. With it alone weights are read, and
    slopes, the derivatives of `a` by what is differentiated by, or None for 1.
    """
    real, run = dtype, wp.types.vector(length=lanes, dtype=dtype)
    taps, radius = wp.constant(2 * RADIUS + 1), wp.constant(RADIUS)
    c1, c2 = wp.constant(real(C1)), wp.constant(real(C2))
    options = FORWARD
    # The CPU's compiler takes many times as long where the loop over the window is written out, which a GPU gains by.
    compare_options = FORWARD if lanes == 1 else FORWARD | {"max_unroll": 8}
    strip_options = FORWARD | {"max_unroll": 32}
    column, windowed = vector(STRIP + 2 * RADIUS, dtype), vector(STRIP, dtype)
    window_type = vector(2 * RADIUS + 1, dtype)

    @wp.func
    def blurred_column(values: column, taps_of: window_type) -> windowed:
        """The weighted sums around the STRIP middle ones of a column."""
        sums = windowed()
        for row in range(wp.static(STRIP)):
            total = real(0.0)
            for k in range(wp.static(2 * RADIUS + 1)):
                total += values[row + k] * taps_of[k]
            sums[row] = total
        return sums

    @wp.func
    def window_of(weights: wp.array(dtype=real)) -> window_type:
        taps_of = window_type()
        for k in range(wp.static(2 * RADIUS + 1)):
            taps_of[k] = weights[k]
        return taps_of

    @wp.func
    def place_of(index: int, length: int, margin: int):
        """Row of a thread's run and its start there, from -margin. The last run of a row overlaps the one before it and
        writes the same values again."""
        span = length + 2 * margin
        blocks = (span + wp.static(lanes - 1)) // wp.static(lanes)
        return index // blocks, wp.min(index % blocks * wp.static(lanes), span - wp.static(lanes)) - margin

    @wp.kernel(module="unique", module_options=options)
    def blur_columns(
        first: int,
        a: wp.array2d(dtype=run), b: wp.array2d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        moments: wp.array3d(dtype=run),
    ):
        margin = radius * channels
        y, i = place_of(first + wp.tid(), length, 0)
        s1 = run(real(0.0))
        d1 = run(real(0.0))
        s2 = run(real(0.0))
        d2 = run(real(0.0))
        for row in range(wp.max(0, y - radius), wp.min(a.shape[0], y + radius + 1)):
            weight = weights[row - y + radius]
            x = a[row, i]
            z = b[row, i]
            s = x + z
            d = x - z
            s1 += s * weight
            d1 += d * weight
            s2 += wp.cw_mul(s, s) * weight
            d2 += wp.cw_mul(d, d) * weight
        i += margin
        moments[0, y, i] = s1
        moments[1, y, i] = d1
        moments[2, y, i] = s2
        moments[3, y, i] = d2

    @wp.kernel(module="unique", module_options=strip_options)
    def blur_columns_in_strips(
        first: int,
        a: wp.array2d(dtype=run), b: wp.array2d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        moments: wp.array3d(dtype=run),
    ):
        margin = radius * channels
        strip, i = place_of(first + wp.tid(), length, margin)
        top = strip * wp.static(STRIP)
        inside = i >= 0 and i < length
        near = wp.clamp(i, 0, length - 1)
        sums = column()
        differences = column()
        for row in range(wp.static(STRIP + 2 * RADIUS)):
            y = top + row - radius
            # Read in any case: a branch would wait for each.
            x = a[wp.clamp(y, 0, a.shape[0] - 1), near][0]
            z = b[wp.clamp(y, 0, a.shape[0] - 1), near][0]
            counts = inside and y >= 0 and y < a.shape[0]
            sums[row] = wp.where(counts, x + z, real(0.0))
            differences[row] = wp.where(counts, x - z, real(0.0))
        taps_of = window_of(weights)
        s1 = blurred_column(sums, taps_of)
        d1 = blurred_column(differences, taps_of)
        s2 = blurred_column(wp.cw_mul(sums, sums), taps_of)
        d2 = blurred_column(wp.cw_mul(differences, differences), taps_of)
        for row in range(wp.static(STRIP)):
            if top + row < a.shape[0]:
                moments[0, top + row, i + margin] = run(s1[row])
                moments[1, top + row, i + margin] = run(d1[row])
                moments[2, top + row, i + margin] = run(s2[row])
                moments[3, top + row, i + margin] = run(d2[row])

    @wp.kernel(module="unique", module_options=compare_options)
    def compare(
        first: int,
        moments: wp.array3d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        a: wp.array2d(dtype=run), b: wp.array2d(dtype=run),
        distance_weight: real, dissimilarity_weight: real,
        similarity: wp.array2d(dtype=run), derivatives: wp.array3d(dtype=run),
    ):
        y, i = place_of(first + wp.tid(), length, 0)
        ms = run(real(0.0))
        md = run(real(0.0))
        ss = run(real(0.0))
        dd = run(real(0.0))
        for k in range(taps):
            weight = weights[k]
            ms += moments[0, y, i + k * channels] * weight
            md += moments[1, y, i + k * channels] * weight
            ss += moments[2, y, i + k * channels] * weight
            dd += moments[3, y, i + k * channels] * weight
        one = run(real(1.0))
        zero = run(real(0.0))
        half = real(0.5)
        md2 = wp.cw_mul(md, md)
        ms2 = wp.cw_mul(ms, ms)
        # Rounding can leave a variance below zero, which would take the second factor out of [-1, 1].
        vs = wp.max(ss - ms2, zero)
        vd = wp.max(dd - md2, zero)
        ra = wp.cw_div(one, (ms2 + md2) * half + run(c1))
        rb = wp.cw_div(one, (vs + vd) * half + run(c2))
        qa = wp.cw_mul(md2, ra)
        qb = wp.cw_mul(vd, rb)
        luminance = one - qa
        structure = one - qb
        if wp.static(distance):
            apart = wp.abs(a[y, i] - b[y, i])
            similarity[y, i] = apart * distance_weight + (one - wp.cw_mul(luminance, structure)) * dissimilarity_weight
        else:
            similarity[y, i] = wp.cw_mul(luminance, structure)
        # d/dE[s^2], d/dE[d^2], then d/dE[s] + d/dE[d], since both s and d follow `a` with slope one.
        by_ss = wp.cw_mul(wp.cw_mul(luminance, qb), rb) * half
        by_dd = by_ss - wp.cw_mul(luminance, rb)
        by_sd = wp.cw_mul(wp.cw_mul(structure, ra), wp.cw_mul(qa, ms + md) - md * real(2.0))
        by_sd -= (wp.cw_mul(by_ss, ms) + wp.cw_mul(by_dd, md)) * real(2.0)
        derivatives[0, y, i] = by_sd
        derivatives[1, y, i] = by_ss
        derivatives[2, y, i] = by_dd

    @wp.func
    def pixels_of(index: int, length: int, channels: int):
        """Row of a thread's STRIP pixels, and the place of the first one's number there."""
        groups = (length // channels + wp.static(STRIP - 1)) // wp.static(STRIP) * channels
        y = index // groups
        rest = index - y * groups
        group = rest // channels
        return y, group * wp.static(STRIP - 1) * channels + rest

    @wp.func
    def blurred_row(planes: wp.array3d(dtype=run), plane: int, y: int, i: int, channels: int, taps_of: window_type):
        values = column()
        final = planes.shape[2] - 1
        for k in range(wp.static(STRIP + 2 * RADIUS)):
            values[k] = planes[plane, y, wp.min(i + k * channels, final)][0]
        return blurred_column(values, taps_of)

    @wp.kernel(module="unique", module_options=options)
    def blur_derivatives(
        first: int,
        derivatives: wp.array3d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        blurred: wp.array3d(dtype=run),
    ):
        margin = radius * channels
        y, i = place_of(first + wp.tid(), length, 0)
        sd = run(real(0.0))
        ss = run(real(0.0))
        dd = run(real(0.0))
        for row in range(wp.max(0, y - radius), wp.min(derivatives.shape[1], y + radius + 1)):
            weight = weights[row - y + radius]
            sd += derivatives[0, row, i] * weight
            ss += derivatives[1, row, i] * weight
            dd += derivatives[2, row, i] * weight
        i += margin
        blurred[0, y, i] = sd
        blurred[1, y, i] = ss
        blurred[2, y, i] = dd

    @wp.kernel(module="unique", module_options=strip_options)
    def blur_derivatives_in_strips(
        first: int,
        derivatives: wp.array3d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        blurred: wp.array3d(dtype=run),
    ):
        margin = radius * channels
        rows = derivatives.shape[1]
        strips = (rows + wp.static(STRIP - 1)) // wp.static(STRIP)
        strip, i = place_of(first + wp.tid(), length, margin)
        plane = strip // strips
        top = (strip - plane * strips) * wp.static(STRIP)
        inside = i >= 0 and i < length
        near = wp.clamp(i, 0, length - 1)
        values = column()
        for row in range(wp.static(STRIP + 2 * RADIUS)):
            y = top + row - radius
            value = derivatives[plane, wp.clamp(y, 0, rows - 1), near][0]
            values[row] = wp.where(inside and y >= 0 and y < rows, value, real(0.0))
        sums = blurred_column(values, window_of(weights))
        for row in range(wp.static(STRIP)):
            if top + row < rows:
                blurred[plane, top + row, i + margin] = run(sums[row])

    @wp.kernel(module="unique", module_options=options)
    def gradient(
        first: int,
        blurred: wp.array3d(dtype=run), a: wp.array2d(dtype=run), b: wp.array2d(dtype=run),
        weights: wp.array(dtype=real),
        length: int, channels: int,
        scale: wp.array(dtype=real), slopes: wp.array2d(dtype=run),
        distance_weight: real, dissimilarity_weight: real,
        adjoint_a: wp.array2d(dtype=run),
    ):
        y, i = place_of(first + wp.tid(), length, 0)
        sd = run(real(0.0))
        ss = run(real(0.0))
        dd = run(real(0.0))
        for k in range(weights.shape[0]):  # Not a constant, for the same reason: one lane has gradient_in_strips.
            weight = weights[k]
            sd += blurred[0, y, i + k * channels] * weight
            ss += blurred[1, y, i + k * channels] * weight
            dd += blurred[2, y, i + k * channels] * weight
        x = a[y, i]
        z = b[y, i]
        moments = (wp.cw_mul(x + z, ss) + wp.cw_mul(x - z, dd)) * real(2.0)
        if wp.static(distance):
            d = x - z
            side = run(real(0.0))
            for k in range(wp.static(lanes)):
                side[k] = wp.where(d[k] > real(0.0), real(1.0), wp.where(d[k] < real(0.0), real(-1.0), real(0.0)))
            by_a = (side * distance_weight - (sd + moments) * dissimilarity_weight) * scale[0]
            if slopes:
                by_a = wp.cw_mul(by_a, slopes[y, i])
            adjoint_a[y, i] = by_a
        else:
            adjoint_a[y, i] = (sd + moments) * scale[0]

    @wp.kernel(module="unique", module_options=strip_options)
    def gradient_in_strips(
        first: int,
        blurred: wp.array3d(dtype=run), a: wp.array2d(dtype=run), b: wp.array2d(dtype=run),
        weights: wp.array(dtype=real),
        length: int, channels: int,
        scale: wp.array(dtype=real), slopes: wp.array2d(dtype=run),
        distance_weight: real, dissimilarity_weight: real,
        adjoint_a: wp.array2d(dtype=run),
    ):
        y, start = pixels_of(first + wp.tid(), length, channels)
        taps_of = window_of(weights)
        sd = blurred_row(blurred, 0, y, start, channels, taps_of)
        ss = blurred_row(blurred, 1, y, start, channels, taps_of)
        dd = blurred_row(blurred, 2, y, start, channels, taps_of)
        for k in range(wp.static(STRIP)):
            i = start + k * channels
            if i < length:
                x = a[y, i][0]
                z = b[y, i][0]
                by_a = sd[k] + ((x + z) * ss[k] + (x - z) * dd[k]) * real(2.0)
                if wp.static(distance):
                    side = wp.where(x > z, real(1.0), wp.where(x < z, real(-1.0), real(0.0)))
                    by_a = side * distance_weight - by_a * dissimilarity_weight
                    if slopes:
                        by_a *= slopes[y, i][0]
                adjoint_a[y, i] = run(by_a * scale[0])

    if lanes == 1:
        blur_columns, blur_derivatives = blur_columns_in_strips, blur_derivatives_in_strips
        gradient = gradient_in_strips
    return SimpleNamespace(
        run=run, blur_columns=blur_columns, compare=compare, blur_derivatives=blur_derivatives, gradient=gradient
    )
