"""Structural similarity (Wang et al. 2004) and its gradient: separable Gaussian windows over two images.

Written in the sum s = a + b and the difference d = a - b, whose windowed moments give

    SSIM = (1 - m_d^2 / ((m_s^2 + m_d^2) / 2 + C1)) (1 - v_d / ((v_s + v_d) / 2 + C2)),   v = E[x^2] - E[x]^2

which equals the usual quotient. It needs four blurs in place of five, and both factors are one minus something small:
near-identical images lose no digits, however bright they are.

A row of the image is one run of W C numbers, channel fastest, so that a step of one pixel is a shift by C numbers and
every kernel works on `lanes` neighboring numbers at once, 16 as a rule: LLVM turns its serial loop into SIMD. Arrays
of runs are overlapping views: element [y, i] holds the numbers i .. i + lanes - 1 of row y. Rows blurred vertically
carry RADIUS pixels of zeros on both sides (zero padding, as in 3DGS). ssim_cuda.py has the kernels of a GPU.
"""

from functools import cache
from math import exp
from types import SimpleNamespace

import warp as wp

from .constants import NO_AUTODIFF
from .geometry import vector

RADIUS = 5
SIGMA = 1.5
# (0.01 L)^2 and (0.03 L)^2 for the data range L = 1.
C1 = 0.01**2
C2 = 0.03**2


def window() -> list[float]:
    """Return the 2 RADIUS + 1 weights of the Gaussian window, which sum to one."""
    weights = [exp(-((i - RADIUS) ** 2) / (2.0 * SIGMA**2)) for i in range(2 * RADIUS + 1)]
    return [weight / sum(weights) for weight in weights]


@cache
def comparison(dtype, lanes: int):
    """Return the function that computes SSIM from windowed moments E[s], E[d], E[s^2], E[d^2].

    Each moment is `lanes` numbers of one scalar type. Its derivatives are by E[s] and E[d] together, E[s^2] and E[d^2],
    as far as they depend on `a`.
    """
    real, run = dtype, vector(lanes, dtype)

    @wp.func
    def similarity_of(ms: run, md: run, ss: run, dd: run):
        one = run(real(1.0))
        zero = run(real(0.0))
        half = real(0.5)
        md2 = wp.cw_mul(md, md)
        ms2 = wp.cw_mul(ms, ms)
        # Rounding can leave a variance below zero, which would take the second factor out of [-1, 1].
        vs = wp.max(ss - ms2, zero)
        vd = wp.max(dd - md2, zero)
        ra = wp.cw_div(one, (ms2 + md2) * half + run(real(C1)))
        rb = wp.cw_div(one, (vs + vd) * half + run(real(C2)))
        qa = wp.cw_mul(md2, ra)
        qb = wp.cw_mul(vd, rb)
        luminance = one - qa
        structure = one - qb
        grad_ss = wp.cw_mul(wp.cw_mul(luminance, qb), rb) * half
        grad_dd = grad_ss - wp.cw_mul(luminance, rb)
        # d/dE[s] + d/dE[d], since both s and d follow `a` with slope one.
        grad_sd = wp.cw_mul(wp.cw_mul(structure, ra), wp.cw_mul(qa, ms + md) - md * real(2.0))
        grad_sd -= (wp.cw_mul(grad_ss, ms) + wp.cw_mul(grad_dd, md)) * real(2.0)
        return wp.cw_mul(luminance, structure), grad_sd, grad_ss, grad_dd

    return similarity_of


@cache
def ssim_kernels(dtype, lanes: int, distance: bool = False) -> SimpleNamespace:
    """Return the four passes for one scalar type (wp.float32 or wp.float64); images need W C >= lanes.

    blur_columns, then compare: the SSIM map and its derivatives by the four windowed moments, combined for `a`.
    blur_derivatives, then gradient: the adjoint of the blurs, applied to those derivatives.

    A launch has rows * ceil(W C / lanes) threads. distance: compute a weighted sum of |a - b| and 1 - SSIM in place of
    the SSIM. Only then weights are read, and slopes, the derivatives of `a` by the variable, or None for 1.
    """
    real, run = dtype, vector(lanes, dtype)
    taps, radius = wp.constant(2 * RADIUS + 1), wp.constant(RADIUS)
    similarity_of = comparison(dtype, lanes)
    options = NO_AUTODIFF
    # The compiler takes many times as long where the loop over the window is written out.
    compare_options = NO_AUTODIFF | {"max_unroll": 8}

    @wp.func
    def run_of_thread(index: int, length: int):
        """Return the row of a thread's run and its start there.

        The last run of a row overlaps the one before it and writes the same values again.
        """
        blocks = (length + wp.static(lanes - 1)) // wp.static(lanes)
        return index // blocks, wp.min(index % blocks * wp.static(lanes), length - wp.static(lanes))

    @wp.kernel(module="unique", module_options=options)
    def blur_columns(
        range_start: int,
        a: wp.array2d(dtype=run), b: wp.array2d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        moments: wp.array3d(dtype=run),
    ):
        margin = radius * channels
        y, i = run_of_thread(range_start + wp.tid(), length)
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

    @wp.kernel(module="unique", module_options=compare_options)
    def compare(
        range_start: int,
        moments: wp.array3d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        a: wp.array2d(dtype=run), b: wp.array2d(dtype=run),
        distance_weight: real, dissimilarity_weight: real,
        similarity: wp.array2d(dtype=run), derivatives: wp.array3d(dtype=run),
    ):
        y, i = run_of_thread(range_start + wp.tid(), length)
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
        similarity_value, grad_sd, grad_ss, grad_dd = similarity_of(ms, md, ss, dd)
        if wp.static(distance):
            apart = wp.abs(a[y, i] - b[y, i])
            similarity[y, i] = apart * distance_weight + (run(real(1.0)) - similarity_value) * dissimilarity_weight
        else:
            similarity[y, i] = similarity_value
        derivatives[0, y, i] = grad_sd
        derivatives[1, y, i] = grad_ss
        derivatives[2, y, i] = grad_dd

    @wp.kernel(module="unique", module_options=options)
    def blur_derivatives(
        range_start: int,
        derivatives: wp.array3d(dtype=run), weights: wp.array(dtype=real),
        length: int, channels: int,
        blurred: wp.array3d(dtype=run),
    ):
        margin = radius * channels
        y, i = run_of_thread(range_start + wp.tid(), length)
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
        range_start: int,
        blurred: wp.array3d(dtype=run), a: wp.array2d(dtype=run), b: wp.array2d(dtype=run),
        weights: wp.array(dtype=real),
        length: int, channels: int,
        scale: wp.array(dtype=real), slopes: wp.array2d(dtype=run),
        distance_weight: real, dissimilarity_weight: real,
        grad_a_rows: wp.array2d(dtype=run),
    ):
        y, i = run_of_thread(range_start + wp.tid(), length)
        sd = run(real(0.0))
        ss = run(real(0.0))
        dd = run(real(0.0))
        for k in range(weights.shape[0]):  # Not a constant, for the same reason.
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
            grad_a = (side * distance_weight - (sd + moments) * dissimilarity_weight) * scale[0]
            if slopes:
                grad_a = wp.cw_mul(grad_a, slopes[y, i])
            grad_a_rows[y, i] = grad_a
        else:
            grad_a_rows[y, i] = (sd + moments) * scale[0]

    return SimpleNamespace(
        run=run, blur_columns=blur_columns, compare=compare, blur_derivatives=blur_derivatives, gradient=gradient
    )
