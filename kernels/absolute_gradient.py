"""Absolute gradients of 2D means (AbsGS, Ye et al. 2024): sums over pixels of |dL/dx| and |dL/dy|.

In the plain gradient of a center the pixels on its two sides cancel; a sum of absolute values shows that a Gaussian
should be split. One thread takes one pixel, walks its tile's list to the front's end and then back as the backward
pass of sphere.py does.
"""

from functools import cache

import warp as wp

from .constants import ALPHA_MAX, NO_AUTODIFF, TRANSMITTANCE_MIN
from .geometry import geometry, pixel_of_thread


@cache
def absolute_gradient_kernel(dtype):
    """Return the kernel for one scalar type, launched over 256 threads for each tile.

    gradients: added to at emit_indices[intersection]: |dL/dx|, |dL/dy| in units of the loss per pixel.
    """
    g = geometry(dtype)
    real, vec2, vec4 = g.real, g.vec2, g.vec4

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def absolute_gradient(
        range_start: int,
        tile_ranges: wp.array(dtype=wp.vec2i), gaussians: wp.array(dtype=wp.int32),
        emit_indices: wp.array(dtype=wp.int32),
        means_opacities: wp.array(dtype=vec4), conics_cutoffs: wp.array(dtype=vec4), features: wp.array2d(dtype=real),
        columns: int, width: int, height: int, alpha_threshold: real,
        grad_image: wp.array2d(dtype=real), grad_transmittance: wp.array(dtype=real),
        # outputs
        gradients: wp.array(dtype=vec2),
    ):
        tile_x_y = pixel_of_thread(range_start + wp.tid(), columns)
        column = tile_x_y[1]
        row = tile_x_y[2]
        if column < width and row < height:
            pixel = row * width + column
            bounds = tile_ranges[tile_x_y[0]]
            t = real(1.0)
            end = bounds[0]
            k = bounds[0]
            while k < bounds[1]:
                xy_opacity = means_opacities[gaussians[k]]
                conic = conics_cutoffs[gaussians[k]]
                dx = xy_opacity[0] - (real(column) + real(0.5))
                dy = xy_opacity[1] - (real(row) + real(0.5))
                k += 1
                alpha = wp.min(
                    real(ALPHA_MAX), xy_opacity[2] * wp.exp(g.splat_exponent(conic[0], conic[1], conic[2], dx, dy))
                )
                if alpha > alpha_threshold:
                    remaining = t - t * alpha
                    if remaining <= real(TRANSMITTANCE_MIN):
                        k = bounds[1]
                    else:
                        t = remaining
                        end = k
            grad_from_behind = t * grad_transmittance[pixel]
            while end > bounds[0]:
                end -= 1
                i = gaussians[end]
                xy_opacity = means_opacities[i]
                conic = conics_cutoffs[i]
                dx = xy_opacity[0] - (real(column) + real(0.5))
                dy = xy_opacity[1] - (real(row) + real(0.5))
                unclamped = xy_opacity[2] * wp.exp(g.splat_exponent(conic[0], conic[1], conic[2], dx, dy))
                alpha = wp.min(real(ALPHA_MAX), unclamped)
                if alpha > alpha_threshold:
                    inverse = real(1.0) / (real(1.0) - alpha)
                    t += t * (alpha * inverse)
                    through = real(0.0)
                    for channel in range(features.shape[1]):
                        through += features[i, channel] * grad_image[pixel, channel]
                    grad_alpha = t * through - grad_from_behind * inverse
                    grad_from_behind += alpha * t * through
                    if unclamped < real(ALPHA_MAX):
                        slope = wp.abs(alpha * grad_alpha)
                        grad_mean = vec2(
                            slope * wp.abs(conic[0] * dx + conic[1] * dy), slope * wp.abs(conic[1] * dx + conic[2] * dy)
                        )
                        wp.atomic_add(gradients, emit_indices[end], grad_mean)

    return absolute_gradient
