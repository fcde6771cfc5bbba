"""Similarity of photos at points along the rays of pixels: the costs of a plane sweep (Collins 1996).

A patch around a pixel is carried to a depth, parallel to its photo's plane, and from there into neighboring photos.
Each of the patch's pixels counts as far as its color is that of the pixel in the middle (Yoon and Kweon 2006): a small
bright thing is then compared by itself, and not together with the wall that another photo shows behind it.
"""

import warp as wp

from .constants import NO_AUTODIFF

RADIUS = wp.constant(2)
"""Patches are 5 x 5 pixels."""
WHITE = wp.constant(765.0)
"""Codes of a white pixel, all channels together: in units of it differences are means of the channels in [0, 1]."""
SIMILARITY = wp.constant(0.1)
"""A pixel whose color differs by so much, in the mean of the channels, counts 1 / e as much."""
LARGEST = wp.constant(0.25)
"""Differences count up to here: what a photo does not see must not outweigh what others see."""
MOST_NEIGHBORS = 8

SIDE = 2 * int(RADIUS) + 1
costs8 = wp.types.vector(length=8, dtype=wp.float32)
_patch = wp.types.vector(length=SIDE * SIDE, dtype=wp.float32)


@wp.func
def color_at(photos: wp.array(dtype=wp.vec4ub), index: wp.int64) -> wp.vec4:
    """Return the four codes of a pixel."""
    code = photos[index]
    return wp.vec4(float(code[0]), float(code[1]), float(code[2]), float(code[3]))


@wp.func
def difference(a: wp.vec4, b: wp.vec4) -> float:
    """Return the sum over channels of the absolute differences of codes."""
    apart = a - b
    return wp.abs(apart[0]) + wp.abs(apart[1]) + wp.abs(apart[2])


@wp.func
def color_between(
    photos: wp.array(dtype=wp.vec4ub), offset: wp.int64, width: int, height: int, u: float, v: float
) -> wp.vec4:
    """Return the bilinear color at u, v, from the first pixel's center; they lie in the photo up to rounding."""
    left, top = wp.clamp(int(u), 0, width - 2), wp.clamp(int(v), 0, height - 2)
    a, b = u - float(left), v - float(top)
    above = offset + wp.int64(top * width + left)
    below = above + wp.int64(width)
    upper = color_at(photos, above) * (1.0 - a) + color_at(photos, above + wp.int64(1)) * a
    lower = color_at(photos, below) * (1.0 - a) + color_at(photos, below + wp.int64(1)) * a
    return upper * (1.0 - b) + lower * b


@wp.func
def in_pixels(lens: wp.vec4, point: wp.vec3) -> wp.vec3:
    """Column and row, from the middle of the first pixel, times the depth, and the depth."""
    return wp.vec3(
        lens[0] * point[0] + (lens[2] - 0.5) * point[2], lens[1] * point[1] + (lens[3] - 0.5) * point[2], point[2]
    )


@wp.func
def is_inside(pixel: wp.vec3, nearest: float, right: float, bottom: float) -> bool:
    """Return whether a projected pixel is beyond the nearest depth and inside of the image."""
    u, v = pixel[0] / pixel[2], pixel[1] / pixel[2]
    return pixel[2] > nearest and u >= 0.0 and v >= 0.0 and u < right and v < bottom


@wp.func
def in_order(costs: costs8, count: int, cost: float) -> costs8:
    """Return the first `count` costs with one more inserted, the best first."""
    result = costs
    rank = int(count)
    while rank > 0 and result[wp.max(rank - 1, 0)] > cost:
        result[rank] = result[rank - 1]
        rank -= 1
    result[rank] = cost
    return result


@wp.func
def better_half(costs: costs8, count: int) -> float:
    """Return the mean of the better half, at least two, of `count` sorted costs; 2 * LARGEST if there are fewer."""
    result = 2.0 * LARGEST
    if count >= 2:
        half = wp.max(2, (count + 1) / 2)
        result = float(0.0)
        for slot in range(half):
            result += costs[slot] / float(half)
    return result


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def sweep(
    range_start: int,
    photos: wp.array(dtype=wp.vec4ub), offsets: wp.array(dtype=wp.int64), sizes: wp.array2d(dtype=wp.int32),
    intrinsics: wp.array(dtype=wp.vec4), neighbors: wp.array2d(dtype=wp.int32), between: wp.array2d(dtype=wp.mat44),
    pixels: wp.array2d(dtype=wp.int32), depths: wp.array2d(dtype=wp.float32),
    costs: wp.array2d(dtype=wp.float32),
):
    """Compute matching costs: costs[n, d] of pixel n at depths[n, d], in [0, LARGEST].

    A cost is the mean over the better half of the neighbors of the mean difference to them; 2 * LARGEST if fewer than
    two neighbors show the place.

    photos: all pixels, RGB and a code that is not read, one photo after another from offsets [V]. sizes: [V, 2] width
    and height. intrinsics: fx, fy, cx, cy. neighbors: [V, K <= 8], -1 for none. between: [V, K] from a view's axes to
    its neighbor's. pixels: [N, 3] view, column, row, at least RADIUS from the border. depths: [N, D] along the view's
    axis.
    """
    i = range_start + wp.tid()
    count = depths.shape[1]
    n = i / count
    view, column, row = pixels[n, 0], pixels[n, 1], pixels[n, 2]
    width, own = sizes[view, 0], intrinsics[view]
    depth = depths[n, i - n * count]
    index = offsets[view] + wp.int64(row * width + column)
    middle = color_at(photos, index)

    weights = _patch()
    total = float(0.0)
    for y in range(wp.static(SIDE)):
        for x in range(wp.static(SIDE)):
            color = color_at(photos, index + wp.int64((y - RADIUS) * width + x - RADIUS))
            weight = wp.exp(difference(color, middle) * (-1.0 / (WHITE * SIMILARITY)))
            weights[y * wp.static(SIDE) + x] = weight
            total += weight
    total *= WHITE

    best = costs8()
    neighbor_count = int(0)
    here = depth * wp.vec3((float(column) + 0.5 - own[2]) / own[0], (float(row) + 0.5 - own[3]) / own[1], 1.0)
    reach = float(RADIUS)
    for slot in range(neighbors.shape[1]):
        other = neighbors[view, slot]
        if other >= 0:
            to_other, lens = between[view, slot], intrinsics[other]
            # A patch is flat: pixels times depths are sums of steps from its middle, and its corners tell of all.
            center = in_pixels(lens, wp.transform_point(to_other, here))
            across = in_pixels(lens, wp.transform_vector(to_other, wp.vec3(depth / own[0], 0.0, 0.0)))
            down = in_pixels(lens, wp.transform_vector(to_other, wp.vec3(0.0, depth / own[1], 0.0)))
            size = wp.vec2i(sizes[other, 0], sizes[other, 1])
            right, bottom, nearest = float(size[0] - 1), float(size[1] - 1), 1.0e-6 * depth
            if (
                is_inside(center - reach * (across + down), nearest, right, bottom)
                and is_inside(center + reach * (across - down), nearest, right, bottom)
                and is_inside(center - reach * (across - down), nearest, right, bottom)
                and is_inside(center + reach * (across + down), nearest, right, bottom)
            ):
                offset = offsets[other]
                unlike = float(0.0)
                for y in range(wp.static(SIDE)):
                    for x in range(wp.static(SIDE)):
                        pixel = center + float(x - RADIUS) * across + float(y - RADIUS) * down
                        nearness = 1.0 / pixel[2]
                        u, v = pixel[0] * nearness, pixel[1] * nearness
                        color_there = color_between(photos, offset, size[0], size[1], u, v)
                        color = color_at(photos, index + wp.int64((y - RADIUS) * width + x - RADIUS))
                        apart = wp.min(difference(color, color_there), WHITE * LARGEST)
                        unlike += weights[y * wp.static(SIDE) + x] * apart
                best = in_order(best, neighbor_count, unlike / total)
                neighbor_count += 1
    costs[n, i - n * count] = better_half(best, neighbor_count)


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def trust_depths(
    range_start: int,
    costs: wp.array2d(dtype=wp.float32), planes: wp.array(dtype=wp.float32),
    worst: float, factor: float, slack: float, few: int, widest: float,
    depths: wp.array(dtype=wp.float32),
):
    """Write to depths[n] the depth of least cost among planes[d], at least three, farthest first; 0 if untrusted.

    Costs below factor times the least, plus slack, are as good. They are trusted where the least is below worst and
    they span fewer than `few` planes: the depth is then that of a parabola through the least and those beside it; or
    depths within a factor of `widest`: then the middle of these.
    """
    n = range_start + wp.tid()
    count = planes.shape[0]
    least = float(wp.inf)
    best = int(0)
    for d in range(count):
        if costs[n, d] < least:
            least = costs[n, d]
            best = d
    depth = float(0.0)
    if least < worst:
        begin = int(best)
        end = int(best)
        for d in range(count):
            if costs[n, d] < factor * least + slack:
                begin = wp.min(begin, d)
                end = wp.max(end, d)
        near = 1.0 / planes[end]
        far = 1.0 / planes[begin]
        if end - begin < few:
            middle = wp.clamp(best, 1, count - 2)
            before, at, after = costs[n, middle - 1], costs[n, middle], costs[n, middle + 1]
            shift = wp.clamp(0.5 * (before - after) / wp.max(before - 2.0 * at + after, 1.0e-6), -0.5, 0.5)
            beside = wp.where(shift > 0.0, middle + 1, middle - 1)
            depth = 1.0 / wp.lerp(1.0 / planes[middle], 1.0 / planes[beside], wp.abs(shift))
        elif near < widest * far:
            # Anywhere within a thing of one color is as good: its middle is meant.
            depth = 2.0 / (near + far)
    depths[n] = depth


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def place_matches(
    range_start: int,
    photos: wp.array(dtype=wp.vec4ub), offsets: wp.array(dtype=wp.int64), sizes: wp.array2d(dtype=wp.int32),
    intrinsics: wp.array(dtype=wp.vec4), poses: wp.array(dtype=wp.mat44),
    pixels: wp.array2d(dtype=wp.int32), depths: wp.array(dtype=wp.float32),
    points: wp.array(dtype=wp.vec3), colors: wp.array(dtype=wp.vec3), footprints: wp.array(dtype=wp.float32),
):
    """Compute world points, colors in [0, 1] and footprints of pixels [N, 3] at depths [N].

    poses: [V] from the views' axes to the world's. A footprint is what a pixel covers there. Photos as in sweep().
    """
    n = range_start + wp.tid()
    view, column, row = pixels[n, 0], pixels[n, 1], pixels[n, 2]
    lens, depth = intrinsics[view], depths[n]
    x = (float(column) + 0.5 - lens[2]) / lens[0]
    y = (float(row) + 0.5 - lens[3]) / lens[1]
    points[n] = wp.transform_point(poses[view], depth * wp.vec3(x, y, 1.0))
    color = color_at(photos, offsets[view] + wp.int64(row * sizes[view, 0] + column))
    colors[n] = wp.vec3(color[0], color[1], color[2]) / 255.0
    footprints[n] = depth / lens[0]
