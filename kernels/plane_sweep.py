"""How alike photos look at points along the rays of pixels: the costs of a plane sweep (Collins 1996).

A patch around a pixel is carried to a depth, parallel to its photo's plane, and from there into neighboring photos.
Each of the patch's pixels counts as far as its color is that of the pixel in the middle (Yoon and Kweon 2006): a small
bright thing is then compared by itself, and not together with the wall that another photo shows behind it.
"""

import warp as wp

RADIUS = wp.constant(2)
"""Patches are 5 x 5 pixels."""
SIMILARITY = wp.constant(0.1)
"""A pixel whose color differs by so much, in the mean of the channels, counts 1 / e as much."""
LARGEST = wp.constant(0.25)
"""Differences count up to here: what a photo does not see must not outweigh what others see."""
MOST_NEIGHBORS = 8

_costs8 = wp.types.vector(length=8, dtype=wp.float32)


@wp.func
def color_at(photos: wp.array(dtype=wp.uint8), offset: wp.int64, width: int, column: int, row: int) -> wp.vec3:
    place = offset + wp.int64(3) * (wp.int64(row) * wp.int64(width) + wp.int64(column))
    return wp.vec3(float(photos[place]), float(photos[place + wp.int64(1)]), float(photos[place + wp.int64(2)])) / 255.0


@wp.func
def difference(a: wp.vec3, b: wp.vec3) -> float:
    return (wp.abs(a[0] - b[0]) + wp.abs(a[1] - b[1]) + wp.abs(a[2] - b[2])) / 3.0


@wp.func
def color_between(photos: wp.array(dtype=wp.uint8), offset: wp.int64, width: int, u: float, v: float) -> wp.vec3:
    """Bilinear, at u, v from the middle of the first pixel."""
    left, top = int(u), int(v)
    a, b = u - float(left), v - float(top)
    upper = color_at(photos, offset, width, left, top) * (1.0 - a) + color_at(photos, offset, width, left + 1, top) * a
    lower = (color_at(photos, offset, width, left, top + 1) * (1.0 - a)
             + color_at(photos, offset, width, left + 1, top + 1) * a)
    return upper * (1.0 - b) + lower * b


@wp.kernel(module="unique", module_options={"enable_backward": False})
def sweep(
    first: int,
    photos: wp.array(dtype=wp.uint8), offsets: wp.array(dtype=wp.int64), sizes: wp.array2d(dtype=wp.int32),
    intrinsics: wp.array(dtype=wp.vec4), neighbors: wp.array2d(dtype=wp.int32), between: wp.array2d(dtype=wp.mat44),
    pixels: wp.array2d(dtype=wp.int32), depths: wp.array2d(dtype=wp.float32),
    costs: wp.array2d(dtype=wp.float32),
):
    """costs[n, d]: of pixel n at depths[n, d], the mean of the better half of its neighbors' mean differences, in
    [0, LARGEST]; 2 * LARGEST where fewer than two neighbors show it.

    photos: all pixels, one photo after another from offsets [V]; sizes: [V, 2] width and height; intrinsics: fx, fy,
    cx, cy; neighbors: [V, K <= 8], -1 for none; between: [V, K] from a view's axes to its neighbor's; pixels: [N, 3]
    view, column, row, at least RADIUS from the border; depths: [N, D] along the view's axis.
    """
    i = first + wp.tid()
    count = depths.shape[1]
    n = i / count
    view, column, row = pixels[n, 0], pixels[n, 1], pixels[n, 2]
    width, own = sizes[view, 0], intrinsics[view]
    depth = depths[n, i - n * count]
    middle = color_at(photos, offsets[view], width, column, row)

    sums = _costs8()
    hidden = _costs8()
    weights = float(0.0)
    for y in range(-RADIUS, RADIUS + 1):
        for x in range(-RADIUS, RADIUS + 1):
            color = color_at(photos, offsets[view], width, column + x, row + y)
            weight = wp.exp(-difference(color, middle) / SIMILARITY)
            weights += weight
            here = depth * wp.vec3(
                (float(column + x) + 0.5 - own[2]) / own[0], (float(row + y) + 0.5 - own[3]) / own[1], 1.0
            )
            for slot in range(neighbors.shape[1]):
                other = neighbors[view, slot]
                if other >= 0 and hidden[slot] == 0.0:
                    there = wp.transform_point(between[view, slot], here)
                    lens = intrinsics[other]
                    u = lens[0] * there[0] / there[2] + lens[2] - 0.5
                    v = lens[1] * there[1] / there[2] + lens[3] - 0.5
                    right, bottom = sizes[other, 0] - 1, sizes[other, 1] - 1
                    if there[2] > 1.0e-6 * depth and u >= 0.0 and v >= 0.0 and u < float(right) and v < float(bottom):
                        seen = color_between(photos, offsets[other], sizes[other, 0], u, v)
                        sums[slot] = sums[slot] + weight * wp.min(difference(color, seen), LARGEST)
                    else:
                        hidden[slot] = 1.0

    # In order, the best first.
    best = _costs8()
    counted = int(0)
    for slot in range(neighbors.shape[1]):
        if neighbors[view, slot] >= 0 and hidden[slot] == 0.0:
            cost = sums[slot] / weights
            place = int(counted)
            while place > 0 and best[wp.max(place - 1, 0)] > cost:
                best[place] = best[place - 1]
                place -= 1
            best[place] = cost
            counted += 1
    result = 2.0 * LARGEST
    if counted >= 2:
        half = wp.max(2, (counted + 1) / 2)
        result = float(0.0)
        for slot in range(half):
            result += best[slot] / float(half)
    costs[n, i - n * count] = result
