"""Energy and gradient of clipped pixels: smoothness, and the distance from an estimate."""

from functools import cache

import warp as wp

from .constants import NO_AUTODIFF
from .geometry import vector
from .patches import BLOCK_DIM, CHANNELS, ROWS, TURNS, patch_functions

REACH = 3  # Pixels to each side that a clipped pixel is compared with
NOT_CLIPPED = -1.0  # In the place of a logarithm, which is 0 or more


@cache
def _terms_function(dtype):
    real = dtype

    @wp.func
    def terms_of(
        v: real, total: real, clipped: real, smoothness: real, expected: real, precision: real, estimate_weight: real,
    ):
        """Return the energy of a clipped value with logarithm v, and its derivative by v.

        `clipped` values around it, itself included, are clipped; `total` is the sum of their logarithms and m their
        mean, which is held constant. The energy is
        smoothness / 2 (v - m)^2 + estimate_weight / 2 (precision (v - expected))^2. Below white, where v is 0, only the
        last part has a derivative.
        """
        away = v - total / clipped
        off = precision * (v - expected)
        energy = real(0.5) * (smoothness * away * away + estimate_weight * off * off)
        grad_v = estimate_weight * precision * off
        if v > real(0.0):
            grad_v += smoothness * away
        return energy, grad_v

    return terms_of


@cache
def _estimate_function(dtype):
    real = dtype

    @wp.func
    def estimate_of(
        estimates: wp.array(dtype=wp.float16), rows: int, columns: int,
        y: int, x: int, channel: int, height: int, width: int,
    ):
        """Return the expected logarithm and its precision at a value of an image; 0 and 0 without estimates.

        Estimates [rows, columns, 6] cover the same picture as the image [height, width, 3].
        """
        expected = real(0.0)
        precision = real(0.0)
        if estimates:
            cell = ((y * rows) // height * columns + (x * columns) // width) * 6 + channel
            expected = real(wp.float32(estimates[cell]))
            precision = real(wp.float32(estimates[cell + 3]))
        return expected, precision

    return estimate_of


@cache
def clipped_logarithms_kernel(dtype, code):
    """Return the kernel for one scalar type and one type of codes, wp.uint8 or wp.uint16."""
    real = dtype

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def clipped_logarithms(
        range_start: int,
        image: wp.array(dtype=real), codes: wp.array2d(dtype=code), index: wp.array(dtype=wp.int64),
        mask: wp.array(dtype=real), white_code: int, white: real, logarithms: wp.array(dtype=real),
    ):
        """Write max(0, log(image / white)) for clipped values of a flat image [H, W, 3], and NOT_CLIPPED for others.

        A value is clipped if its code in photo index[0] is `white_code` and the mask [H W], if there is one, is not 0.
        """
        i = range_start + wp.tid()
        clipped = int(codes[wp.int32(index[0]), i]) == white_code
        if mask:
            clipped = clipped and mask[i // 3] > real(0.0)
        logarithm = real(NOT_CLIPPED)
        if clipped:
            logarithm = wp.log(wp.max(image[i], white) / white)
        logarithms[i] = logarithm

    return clipped_logarithms


@cache
def clipped_light_kernel(dtype):
    """Return the kernel for one scalar type."""
    real = dtype
    terms_of, estimate_of = _terms_function(dtype), _estimate_function(dtype)

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def clipped_light(
        range_start: int,
        image: wp.array(dtype=real), logarithms: wp.array(dtype=real), white: real, height: int, width: int,
        smoothness: real, estimate_weight: real, estimates: wp.array(dtype=wp.float16), rows: int, columns: int,
        terms: wp.array(dtype=real), gradient: wp.array(dtype=real),
    ):
        """Add terms_of() each clipped value to terms, and its derivative to the gradient.

        image: [H, W, 3], flat. Neighbors are the values of the same channel within REACH. terms: [H W 3]. gradient:
        with respect to the values; may be None.
        """
        i = range_start + wp.tid()
        v = logarithms[i]
        if v >= real(0.0):
            row = i // (3 * width)
            column = i // 3 - width * row
            total = real(0.0)
            clipped = real(0.0)
            for y in range(wp.max(row - wp.static(REACH), 0), wp.min(row + wp.static(REACH + 1), height)):
                for x in range(wp.max(column - wp.static(REACH), 0), wp.min(column + wp.static(REACH + 1), width)):
                    near = logarithms[i + 3 * ((y - row) * width + x - column)]
                    if near >= real(0.0):
                        clipped += real(1.0)
                        total += near
            expected, precision = estimate_of(
                estimates, rows, columns, row, column, i - 3 * (i // 3), height, width
            )
            energy, grad_v = terms_of(v, total, clipped, smoothness, expected, precision, estimate_weight)
            terms[i] = terms[i] + energy
            if gradient:
                gradient[i] = gradient[i] + grad_v / wp.max(image[i], white)

    return clipped_light


@cache
def clipped_light_patch_kernel(dtype, code):
    """Return both of the above as one kernel for CUDA, launched over patches_of() x BLOCK_DIM threads (patches.py)."""
    real = dtype
    vec3, around = vector(3, dtype), vector(ROWS + 2 * REACH, dtype)
    functions = patch_functions(REACH)
    reach, patch_of, column_of, value_of = functions.reach, functions.patch_of, functions.column_of, functions.value_of
    terms_of, estimate_of = _terms_function(dtype), _estimate_function(dtype)
    options = {"module_options": NO_AUTODIFF | {"max_unroll": 32}, "launch_bounds": BLOCK_DIM, "grid_stride": False}

    @wp.kernel(module="unique", **options)
    def clipped_light_in_patches(
        image: wp.array(dtype=real), codes: wp.array2d(dtype=code), index: wp.array(dtype=wp.int64),
        mask: wp.array(dtype=real), white_code: int, white: real, height: int, width: int,
        smoothness: real, estimate_weight: real, estimates: wp.array(dtype=wp.float16), rows: int, columns: int,
        terms: wp.array(dtype=real), gradient: wp.array(dtype=real),
    ):
        """Do what the two kernels above do; a patch's energy is added to its term of terms [patches]."""
        block, thread, top, left, _ = patch_of(wp.tid(), width, 3)
        photo = wp.int32(index[0])
        # Of columns: logarithms, how many there are, and the logarithm in their middle
        sums = wp.tile_empty(shape=(ROWS, reach), dtype=vec3, storage="shared")
        x, channel = column_of(thread, left, 0)
        logarithms = around()
        counts = around()
        near = wp.clamp(x, 0, width - 1)
        for row in range(wp.static(ROWS + 2 * REACH)):
            y = top + row - wp.static(REACH)
            # All are read before one is looked at: a branch would wait for each.
            pixel = wp.clamp(y, 0, height - 1) * width + near
            clipped = int(codes[photo, pixel * 3 + channel]) == white_code and x == near and y >= 0 and y < height
            if mask:
                clipped = clipped and mask[pixel] > real(0.0)
            counts[row] = wp.where(clipped, real(1.0), real(0.0))
            logarithms[row] = image[pixel * 3 + channel]
        for row in range(wp.static(ROWS + 2 * REACH)):
            v = real(NOT_CLIPPED)
            if counts[row] > real(0.0):
                v = wp.log(wp.max(logarithms[row], white) / white)
            is_number = v >= real(0.0)
            counts[row] = wp.where(is_number, real(1.0), real(0.0))
            logarithms[row] = wp.where(is_number, v, real(0.0))
        for row in range(wp.static(ROWS)):
            here = row + wp.static(REACH)
            own = wp.where(counts[here] > real(0.0), logarithms[here], real(NOT_CLIPPED))
            of_column = vec3(real(0.0), real(0.0), own)
            for k in range(wp.static(2 * REACH + 1)):
                of_column += vec3(logarithms[row + k], counts[row + k], real(0.0))
            wp.tile_scatter_masked(sums, row, thread, of_column, thread < wp.static(reach))
        energy = real(0.0)
        for turn in range(wp.static(TURNS)):
            row, at, y, x, channel = value_of(thread, turn, top, left, 0)
            if y < height and x < width:
                i = (y * width + x) * 3 + channel
                v = wp.tile_extract(sums, row, at + wp.static(CHANNELS * REACH))[2]
                if v >= real(0.0):
                    figures = vec3()
                    for k in range(wp.static(2 * REACH + 1)):
                        figures += wp.tile_extract(sums, row, at + wp.static(CHANNELS) * k)
                    expected, precision = estimate_of(estimates, rows, columns, y, x, channel, height, width)
                    term, grad_v = terms_of(v, figures[0], figures[1], smoothness, expected, precision, estimate_weight)
                    energy += term
                    if gradient:
                        gradient[i] = gradient[i] + grad_v / wp.max(image[i], white)
        of_patch = wp.tile_extract(wp.tile_sum(wp.tile(energy)), 0)
        if thread == 0:
            terms[block] = terms[block] + of_patch

    return clipped_light_in_patches
