"""How smooth light is where a photo clips, and how far its edges are lifted: energy and gradient."""

from functools import cache

import warp as wp

from .constants import FORWARD

REACH = 3  # Pixels to each side that a clipped pixel is compared with
NOT_CLIPPED = -1.0  # In the place of a logarithm, which is 0 or more


@cache
def clipped_logarithms_kernel(dtype, code):
    """The kernel for one scalar type and one type of codes, wp.uint8 or wp.uint16."""
    real = dtype

    @wp.kernel(module="unique", module_options=FORWARD)
    def clipped_logarithms(
        first: int,
        image: wp.array(dtype=real), codes: wp.array2d(dtype=code), index: wp.array(dtype=wp.int64),
        mask: wp.array(dtype=real), white_code: int, white: real, logarithms: wp.array(dtype=real),
    ):
        """Of image [H, W, 3], flat, beside photo index[0]: max(0, log(image / white)) where the code is `white_code`
        and the mask [H W], if there is one, is not 0; NOT_CLIPPED elsewhere."""
        i = first + wp.tid()
        clipped = int(codes[wp.int32(index[0]), i]) == white_code
        if mask:
            clipped = clipped and mask[i // 3] > real(0.0)
        found = real(NOT_CLIPPED)
        if clipped:
            found = wp.log(wp.max(image[i], white) / white)
        logarithms[i] = found

    return clipped_logarithms


@cache
def clipped_light_kernel(dtype):
    """The kernel for one scalar type."""
    real = dtype

    @wp.kernel(module="unique", module_options=FORWARD)
    def clipped_light(
        first: int,
        image: wp.array(dtype=real), logarithms: wp.array(dtype=real), height: int, width: int,
        smoothness: real, lift: real, energies: wp.array(dtype=real), slopes: wp.array(dtype=real),
    ):
        """For each clipped value of image [H, W, 3], flat, with v its logarithm and m the mean of those of the n
        clipped values of the channel within REACH, itself one, in N pixels: smoothness / 2 (v - m)^2 less
        lift (1 - n / N) v is added to the energies, and its derivative by the value, with m as it is, to the slopes,
        which may be None."""
        i = first + wp.tid()
        v = logarithms[i]
        if v >= real(0.0):
            row = i // (3 * width)
            column = i // 3 - width * row
            total = real(0.0)
            clipped = int(0)
            pixels = int(0)
            for y in range(wp.max(row - wp.static(REACH), 0), wp.min(row + wp.static(REACH + 1), height)):
                for x in range(wp.max(column - wp.static(REACH), 0), wp.min(column + wp.static(REACH + 1), width)):
                    near = logarithms[i + 3 * ((y - row) * width + x - column)]
                    pixels += 1
                    if near >= real(0.0):
                        clipped += 1
                        total += near
            away = v - total / real(clipped)
            edge = real(1.0) - real(clipped) / real(pixels)
            energies[i] = energies[i] + (real(0.5) * smoothness * away * away - lift * edge * v)
            if slopes and v > real(0.0):
                slopes[i] = slopes[i] + (smoothness * away - lift * edge) / image[i]

    return clipped_light
