"""Pixels drawn where a picture does not explain its photo."""

from functools import cache

import warp as wp

from .constants import FORWARD


@cache
def error_weights_kernel(code):
    """The kernel for one type of codes, wp.uint8 or wp.uint16. Covers the pixels."""

    @wp.kernel(module="unique", module_options=FORWARD)
    def error_weights(
        first: int,
        shown: wp.array(dtype=wp.vec3), codes: wp.array2d(dtype=code), index: wp.array(dtype=wp.int64), white: float,
        mask: wp.array(dtype=wp.float32), least: float, weights: wp.array(dtype=wp.float64),
    ):
        """The squares of the mean differences over the channels of encoded values [H W], held within [0, 1], and codes
        of photo index[0], times the mask, if there is one; 0 where these are not above least."""
        i = first + wp.tid()
        photo = wp.int32(index[0])
        color = shown[i]
        error = float(0.0)
        for channel in range(3):
            error += wp.abs(wp.clamp(color[channel], 0.0, 1.0) - float(codes[photo, 3 * i + channel]) / white) / 3.0
        if mask:
            error *= mask[i]
        weights[i] = wp.float64(wp.where(error > least, error * error, 0.0))

    return error_weights


@wp.kernel(module="unique", module_options=FORWARD)
def sampled_pixels(
    first: int,
    places: wp.array(dtype=wp.int64), total: wp.array(dtype=wp.float64), width: int, view: int,
    across: float, down: float, columns: int, rows: int, border: int,
    pixels: wp.array2d(dtype=wp.int32), meant: wp.array(dtype=wp.bool),
):
    """Places in a photo `width` pixels wide as pixels (view, column, row) of the same photo, columns x rows large,
    across and down times as large, held `border` from its edge; and whether they are meant: they were as far from it,
    and the total of the weights that they were drawn by is above 0."""
    k = first + wp.tid()
    place = wp.int32(places[k])
    row = place // width
    column = int((float(place - row * width) + 0.5) * across)
    row = int((float(row) + 0.5) * down)
    pixels[k, 0] = view
    pixels[k, 1] = wp.clamp(column, border, columns - border - 1)
    pixels[k, 2] = wp.clamp(row, border, rows - border - 1)
    meant[k] = total[0] > wp.float64(0.0) and pixels[k, 1] == column and pixels[k, 2] == row
