"""Pixels drawn where a picture does not explain its photo."""

from functools import cache

import warp as wp

from .constants import NO_AUTODIFF


@cache
def error_weights_kernel(code):
    """Return error_weights() for one type of codes, wp.uint8 or wp.uint16, launched over the pixels."""

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def error_weights(
        range_start: int,
        rendered: wp.array(dtype=wp.vec3), codes: wp.array2d(dtype=code), index: wp.array(dtype=wp.int64), white: float,
        mask: wp.array(dtype=wp.float32), least: float, weights: wp.array(dtype=wp.float64),
    ):
        """Write the squared mean difference over channels between encoded values and the codes of photo index[0].

        Encoded values [H W] are clamped to [0, 1]. Differences are multiplied by the mask, if there is one; those not
        above `least` have weight 0.
        """
        i = range_start + wp.tid()
        photo = wp.int32(index[0])
        color = rendered[i]
        error = float(0.0)
        for channel in range(3):
            error += wp.abs(wp.clamp(color[channel], 0.0, 1.0) - float(codes[photo, 3 * i + channel]) / white) / 3.0
        if mask:
            error *= mask[i]
        weights[i] = wp.float64(wp.where(error > least, error * error, 0.0))

    return error_weights


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def sampled_pixels(
    range_start: int,
    indices: wp.array(dtype=wp.int64), total: wp.array(dtype=wp.float64), width: int, view: int,
    across: float, down: float, columns: int, rows: int, border: int,
    pixels: wp.array2d(dtype=wp.int32), is_sample: wp.array(dtype=wp.bool),
):
    """Convert pixel indices of a photo `width` wide to (view, column, row) of the same photo at another size.

    The other size is columns x rows, across and down times as large. Pixels are clamped to `border` from its edge.
    is_sample: whether a pixel was that far from the edge before and the total of the weights is above 0.
    """
    k = range_start + wp.tid()
    index = wp.int32(indices[k])
    row = index // width
    column = int((float(index - row * width) + 0.5) * across)
    row = int((float(row) + 0.5) * down)
    pixels[k, 0] = view
    pixels[k, 1] = wp.clamp(column, border, columns - border - 1)
    pixels[k, 2] = wp.clamp(row, border, rows - border - 1)
    is_sample[k] = total[0] > wp.float64(0.0) and pixels[k, 1] == column and pixels[k, 2] == row
