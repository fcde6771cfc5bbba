"""Structural similarity (Wang et al. 2004) and its adjoint: separable Gaussian windows over two images.

Written in the sum s = a + b and the difference d = a - b, whose windowed moments give

    SSIM = (1 - m_d^2 / ((m_s^2 + m_d^2) / 2 + C1)) (1 - v_d / ((v_s + v_d) / 2 + C2)),   v = E[x^2] - E[x]^2

which equals the usual quotient. It needs four blurs in place of five, and both factors are one minus something small:
near-identical images lose no digits, however bright they are.

A row of the image is one run of W C numbers, channel fastest, so that a step of one pixel is a shift by C numbers and
every kernel works on `lanes` neighbouring numbers at once: 16 on the CPU, whose serial loop LLVM then turns into SIMD,
and one on the GPU. Arrays of runs are overlapping views: element [y, i] holds the numbers i .. i + lanes - 1 of row y.
Rows blurred vertically carry RADIUS pixels of zeros on both sides (zero padding, as in 3DGS).
"""

from functools import cache
from math import exp
from types import SimpleNamespace

import warp as wp

RADIUS = 5
SIGMA = 1.5
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

    A launch covers [0, rows * blocks) with blocks = ceil(W C / lanes). With one lane the blurs write the zeros on both
    sides too, and cover [0, rows * (W C + 2 RADIUS C)).
    distance: for a weighted sum of |a - b| and 1 - SSIM in place of the SSIM; the weights are read with it alone.
    """
    real, run = dtype, wp.types.vector(length=lanes, dtype=dtype)
    taps, radius = wp.constant(2 * RADIUS + 1), wp.constant(RADIUS)
    # Pixels on both sides that the blurs write too.
    border = wp.constant(RADIUS if lanes == 1 else 0)
    c1, c2 = wp.constant(real(C1)), wp.constant(real(C2))
    options = {"enable_backward": False}

    @wp.func
    def place_of(index: int, length: int, margin: int):
        """Row of a thread's run and its start there, from -margin. The last run of a row overlaps the one before it and
        writes the same values again."""
        span = length + 2 * margin
        blocks = (span + wp.static(lanes - 1)) // wp.static(lanes)
        return index // blocks, wp.min(index % blocks * wp.static(lanes), span - wp.static(lanes)) - margin

    @wp.func
    def write_border(y: int, i: int, margin: int, length: int, planes: wp.array3d(dtype=run)) -> bool:
        """Writes a blur's run where it lies beyond the image, zero; whether it does."""
        if wp.static(lanes == 1) and (i < 0 or i >= length):
            for k in range(planes.shape[0]):
                planes[k, y, i + margin] = run(real(0.0))
            return True
        return False

    @wp.kernel(module="unique", module_options=options)
    def blur_columns(
        first: int,
        a: wp.array2d(dtype=run), b: wp.array2d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        moments: wp.array3d(dtype=run),
    ):
        margin = radius * channels
        y, i = place_of(first + wp.tid(), length, border * channels)
        if write_border(y, i, margin, length, moments):
            return
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

    @wp.kernel(module="unique", module_options=options)
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

    @wp.kernel(module="unique", module_options=options)
    def blur_derivatives(
        first: int,
        derivatives: wp.array3d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        blurred: wp.array3d(dtype=run),
    ):
        margin = radius * channels
        y, i = place_of(first + wp.tid(), length, border * channels)
        if write_border(y, i, margin, length, blurred):
            return
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

    @wp.kernel(module="unique", module_options=options)
    def gradient(
        first: int,
        blurred: wp.array3d(dtype=run), a: wp.array2d(dtype=run), b: wp.array2d(dtype=run),
        weights: wp.array(dtype=real),
        length: int, channels: int,
        scale: wp.array(dtype=real),
        distance_weight: real, dissimilarity_weight: real,
        adjoint_a: wp.array2d(dtype=run),
    ):
        y, i = place_of(first + wp.tid(), length, 0)
        sd = run(real(0.0))
        ss = run(real(0.0))
        dd = run(real(0.0))
        for k in range(taps):
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
            adjoint_a[y, i] = (side * distance_weight - (sd + moments) * dissimilarity_weight) * scale[0]
        else:
            adjoint_a[y, i] = (sd + moments) * scale[0]

    return SimpleNamespace(
        run=run, blur_columns=blur_columns, compare=compare, blur_derivatives=blur_derivatives, gradient=gradient
    )
