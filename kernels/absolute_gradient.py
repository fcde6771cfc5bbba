"""Absolute gradients of 2D means (AbsGS, Ye et al. 2024): sums over pixels of |dL/dx| and |dL/dy|.

In the plain gradient of a centre the pixels on its two sides cancel; a sum of absolute values shows that a Gaussian
should be split. One thread takes one pixel, walks its tile's list to the front's end and then back as sphere.py's
adjoint does.
"""

from functools import cache

import warp as wp

from .constants import ALPHA_MAX, FORWARD, TILE_SIZE, TRANSMITTANCE_MIN
from .geometry import geometry


@cache
def absolute_gradient_kernel(dtype):
    """Return the kernel for one scalar type, launched over 256 threads for each tile.

    rows: added to at places[intersection]: |dL/dx|, |dL/dy| in units of the loss per pixel.
    """
    g = geometry(dtype)
    real, vec2, vec4 = g.real, g.vec2, g.vec4

    @wp.kernel(module="unique", module_options=FORWARD)
    def absolute_gradient(
        first: int,
        ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32), places: wp.array(dtype=wp.int32),
        shapes: wp.array(dtype=vec4), ellipses: wp.array(dtype=vec4), features: wp.array2d(dtype=real),
        columns: int, width: int, height: int, alpha_threshold: real,
        by_image: wp.array2d(dtype=real), by_transmittance: wp.array(dtype=real),
        # outputs
        rows: wp.array(dtype=vec2),
    ):
        thread = first + wp.tid()
        tile = thread // (TILE_SIZE * TILE_SIZE)
        place = thread - tile * (TILE_SIZE * TILE_SIZE)
        column = (tile % columns) * TILE_SIZE + place % TILE_SIZE
        row = (tile // columns) * TILE_SIZE + place // TILE_SIZE
        if column < width and row < height:
            pixel = row * width + column
            bounds = ranges[tile]
            left_over = real(1.0)
            end = bounds[0]
            k = bounds[0]
            while k < bounds[1]:
                shape = shapes[gaussians[k]]
                conic = ellipses[gaussians[k]]
                dx = shape[0] - (real(column) + real(0.5))
                dy = shape[1] - (real(row) + real(0.5))
                k += 1
                alpha = wp.min(
                    real(ALPHA_MAX), shape[2] * wp.exp(g.splat_exponent(conic[0], conic[1], conic[2], dx, dy))
                )
                if alpha > alpha_threshold:
                    remaining = left_over - left_over * alpha
                    if remaining <= real(TRANSMITTANCE_MIN):
                        k = bounds[1]
                    else:
                        left_over = remaining
                        end = k
            behind = left_over * by_transmittance[pixel]
            while end > bounds[0]:
                end -= 1
                i = gaussians[end]
                shape = shapes[i]
                conic = ellipses[i]
                dx = shape[0] - (real(column) + real(0.5))
                dy = shape[1] - (real(row) + real(0.5))
                unclamped = shape[2] * wp.exp(g.splat_exponent(conic[0], conic[1], conic[2], dx, dy))
                alpha = wp.min(real(ALPHA_MAX), unclamped)
                if alpha > alpha_threshold:
                    inverse = real(1.0) / (real(1.0) - alpha)
                    left_over += left_over * (alpha * inverse)
                    through = real(0.0)
                    for channel in range(features.shape[1]):
                        through += features[i, channel] * by_image[pixel, channel]
                    by_alpha = left_over * through - behind * inverse
                    behind += alpha * left_over * through
                    if unclamped < real(ALPHA_MAX):
                        slope = wp.abs(alpha * by_alpha)
                        by_centre = vec2(
                            slope * wp.abs(conic[0] * dx + conic[1] * dy), slope * wp.abs(conic[1] * dx + conic[2] * dy)
                        )
                        wp.atomic_add(rows, places[end], by_centre)

    return absolute_gradient
