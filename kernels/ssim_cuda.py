"""Structural similarity and its gradient for CUDA, one launch each: the math of ssim.py in the patches of patches.py.

These kernels also run on the CPU where wp.config.enable_cpu_blocks is set: slow, but the same logic, for tests.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .constants import NO_AUTODIFF
from .geometry import vector
from .patches import BLOCK_DIM, CHANNELS, ROWS, TURNS, patch_functions
from .ssim import RADIUS, comparison


@cache
def ssim_patch_kernels(dtype, distance: bool = False) -> SimpleNamespace:
    """Return compare() and gradient() for one scalar type (wp.float32 or wp.float64), which also blur.

    As those of ssim_kernels(), over patches_of() x BLOCK_DIM threads. Images are [rows, W C], channel fastest;
    derivatives [3, rows, W C]. With a distance, compare() writes the sum of each patch, [patches], in place of the map.
    """
    real = dtype
    functions = patch_functions(RADIUS)
    reach, patch_of, column_of, value_of = functions.reach, functions.patch_of, functions.column_of, functions.value_of
    vec1, vec3, vec4 = vector(1, dtype), vector(3, dtype), vector(4, dtype)
    around, column, window = vector(ROWS + 2 * RADIUS, dtype), vector(ROWS, dtype), vector(2 * RADIUS + 1, dtype)
    options = {"module_options": NO_AUTODIFF | {"max_unroll": 32}, "launch_bounds": BLOCK_DIM, "grid_stride": False}
    similarity_of = comparison(dtype, 1)

    @wp.func
    def window_of(weights: wp.array(dtype=real)) -> window:
        taps = window()
        for k in range(wp.static(2 * RADIUS + 1)):
            taps[k] = weights[k]
        return taps

    @wp.func
    def blurred(values: around, taps: window) -> column:
        sums = column()
        for row in range(wp.static(ROWS)):
            total = real(0.0)
            for k in range(wp.static(2 * RADIUS + 1)):
                total += values[row + k] * taps[k]
            sums[row] = total
        return sums

    @wp.func
    def values_around(image: wp.array2d(dtype=real), top: int, x: int, channel: int, channels: int) -> around:
        """Return a column and what the window reaches above and below; zeros beyond the image."""
        values = around()
        i = x * channels + channel
        inside = x >= 0 and i < image.shape[1] and channel < channels
        near = wp.clamp(i, 0, image.shape[1] - 1)
        for row in range(wp.static(ROWS + 2 * RADIUS)):
            y = top + row - wp.static(RADIUS)
            # Read in any case: a branch would wait for each.
            value = image[wp.clamp(y, 0, image.shape[0] - 1), near]
            values[row] = wp.where(inside and y >= 0 and y < image.shape[0], value, real(0.0))
        return values

    @wp.kernel(module="unique", **options)
    def compare_patches(
        weights: wp.array(dtype=real), width: int, channels: int,
        a: wp.array2d(dtype=real), b: wp.array2d(dtype=real),
        distance_weight: real, dissimilarity_weight: real,
        similarity: wp.array2d(dtype=real), sums: wp.array(dtype=real), derivatives: wp.array3d(dtype=real),
    ):
        block, thread, top, left, channel = patch_of(wp.tid(), width, channels)
        taps = window_of(weights)
        moments = wp.tile_empty(shape=(ROWS, reach), dtype=vec4, storage="shared")
        across, own = column_of(thread, left, channel)
        x = values_around(a, top, across, own, channels)
        z = values_around(b, top, across, own, channels)
        s = x + z
        d = x - z
        s1 = blurred(s, taps)
        d1 = blurred(d, taps)
        s2 = blurred(wp.cw_mul(s, s), taps)
        d2 = blurred(wp.cw_mul(d, d), taps)
        for row in range(wp.static(ROWS)):
            of_column = vec4(s1[row], d1[row], s2[row], d2[row])
            wp.tile_scatter_masked(moments, row, thread, of_column, thread < wp.static(reach))
        total = real(0.0)
        for turn in range(wp.static(TURNS)):
            row, at, y, across, own = value_of(thread, turn, top, left, channel)
            if y < a.shape[0] and across < width and own < channels:
                i = across * channels + own
                m = vec4()
                for k in range(wp.static(2 * RADIUS + 1)):
                    m += wp.tile_extract(moments, row, at + wp.static(CHANNELS) * k) * taps[k]
                alike, grad_sd, grad_ss, grad_dd = similarity_of(vec1(m[0]), vec1(m[1]), vec1(m[2]), vec1(m[3]))
                if wp.static(distance):
                    apart = wp.abs(a[y, i] - b[y, i])
                    total += apart * distance_weight + (real(1.0) - alike[0]) * dissimilarity_weight
                else:
                    similarity[y, i] = alike[0]
                derivatives[0, y, i] = grad_sd[0]
                derivatives[1, y, i] = grad_ss[0]
                derivatives[2, y, i] = grad_dd[0]
        if wp.static(distance):
            of_patch = wp.tile_extract(wp.tile_sum(wp.tile(total)), 0)
            if thread == 0:
                sums[block] = of_patch

    @wp.kernel(module="unique", **options)
    def gradient_in_patches(
        weights: wp.array(dtype=real), width: int, channels: int,
        derivatives: wp.array3d(dtype=real), a: wp.array2d(dtype=real), b: wp.array2d(dtype=real),
        scale: wp.array(dtype=real), slopes: wp.array2d(dtype=real),
        distance_weight: real, dissimilarity_weight: real,
        grad_a_rows: wp.array2d(dtype=real),
    ):
        _, thread, top, left, channel = patch_of(wp.tid(), width, channels)
        taps = window_of(weights)
        blurs = wp.tile_empty(shape=(ROWS, reach), dtype=vec3, storage="shared")
        across, own = column_of(thread, left, channel)
        sd = blurred(values_around(derivatives[0], top, across, own, channels), taps)
        ss = blurred(values_around(derivatives[1], top, across, own, channels), taps)
        dd = blurred(values_around(derivatives[2], top, across, own, channels), taps)
        for row in range(wp.static(ROWS)):
            of_column = vec3(sd[row], ss[row], dd[row])
            wp.tile_scatter_masked(blurs, row, thread, of_column, thread < wp.static(reach))
        for turn in range(wp.static(TURNS)):
            row, at, y, across, own = value_of(thread, turn, top, left, channel)
            if y < a.shape[0] and across < width and own < channels:
                i = across * channels + own
                by = vec3()
                for k in range(wp.static(2 * RADIUS + 1)):
                    by += wp.tile_extract(blurs, row, at + wp.static(CHANNELS) * k) * taps[k]
                x = a[y, i]
                z = b[y, i]
                grad_a = by[0] + ((x + z) * by[1] + (x - z) * by[2]) * real(2.0)
                if wp.static(distance):
                    side = wp.where(x > z, real(1.0), wp.where(x < z, real(-1.0), real(0.0)))
                    grad_a = side * distance_weight - grad_a * dissimilarity_weight
                    if slopes:
                        grad_a *= slopes[y, i]
                grad_a_rows[y, i] = grad_a * scale[0]

    return SimpleNamespace(compare=compare_patches, gradient=gradient_in_patches)
