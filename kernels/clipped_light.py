"""How smooth light is where a photo clips, and how far its edges are lifted: energy and gradient."""

from functools import cache

import warp as wp

REACH = 3  # Pixels to each side that a clipped pixel is compared with


@cache
def clipped_light_kernel(dtype, code):
    """The kernel for one scalar type and one type of codes, wp.uint8 or wp.uint16."""
    real = dtype

    @wp.func
    def is_clipped(codes: wp.array(dtype=code), mask: wp.array(dtype=real), white_code: int, i: int) -> bool:
        if mask:
            return int(codes[i]) == white_code and mask[i // 3] > real(0.0)
        return int(codes[i]) == white_code

    @wp.kernel(module="unique", module_options={"enable_backward": False, "fuse_fp": False})
    def clipped_light(
        first: int,
        image: wp.array(dtype=real), codes: wp.array2d(dtype=code), index: wp.array(dtype=wp.int64),
        mask: wp.array(dtype=real), height: int, width: int, white_code: int, white: real,
        smoothness: real, lift: real, energies: wp.array(dtype=real), slopes: wp.array(dtype=real),
    ):
        """Of image [H, W, 3], flat, beside photo index[0], for each value whose code is `white_code` where the mask
        [H W], if there is one, is not 0, with v = max(0, log(image / white)), m the mean of v over the n such values of
        the channel within REACH of it, itself one, out of N pixels: smoothness / 2 (v - m)^2 - lift (1 - n / N) v.
        slopes: its derivative by the value, with m as it is. 0 elsewhere."""
        i = first + wp.tid()
        photo = codes[wp.int32(index[0])]
        energy = real(0.0)
        slope = real(0.0)
        if is_clipped(photo, mask, white_code, i):
            pixel = i // 3
            row = pixel // width
            column = pixel - width * row
            total = real(0.0)
            clipped = int(0)
            pixels = int(0)
            for y in range(wp.max(row - wp.static(REACH), 0), wp.min(row + wp.static(REACH + 1), height)):
                for x in range(wp.max(column - wp.static(REACH), 0), wp.min(column + wp.static(REACH + 1), width)):
                    pixels += 1
                    j = i + 3 * ((y - row) * width + x - column)
                    if is_clipped(photo, mask, white_code, j):
                        clipped += 1
                        total += wp.log(wp.max(image[j], white) / white)
            v = wp.log(wp.max(image[i], white) / white)
            away = v - total / real(clipped)
            edge = real(1.0) - real(clipped) / real(pixels)
            energy = real(0.5) * smoothness * away * away - lift * edge * v
            if v > real(0.0):
                slope = (smoothness * away - lift * edge) / image[i]
        energies[i] = energy
        slopes[i] = slope

    return clipped_light
