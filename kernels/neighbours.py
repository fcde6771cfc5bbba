"""Exact nearest neighbours by a tree of boxes over points in Morton order.

The points are put in the Morton order of their *ranks* along each axis, so that the order adapts to any density,
offset or outlier; runs of LEAF_SIZE points in that order are the leaves of a complete binary tree in heap layout (root
1, children 2 n and 2 n + 1, `leaf_count` a power of two) whose boxes are exact. A query starts in its own leaf and
climbs: at each ancestor it searches the other child's subtree, leaving out every box that lies no nearer than the
worst neighbour found so far. Walking left to right in a heap needs no stack.

Everything is float64: the distances are as good as the coordinates, and the cost is that of reading memory.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

LEAF_SIZE = 8
# Bits of a rank that fit three times into a 63-bit code; finer ranks are rounded down.
RANK_BITS = 21


@cache
def neighbour_kernels(k: int) -> SimpleNamespace:
    """The passes of a search for k neighbours: morton_codes, sort (the caller's), leaf_boxes, merge_boxes, nearest."""
    options = {"enable_backward": False}
    leaf_size = wp.constant(LEAF_SIZE)
    nearest_k = wp.types.vector(length=k, dtype=wp.float64)

    @wp.func
    def spread(rank: wp.int64) -> wp.int64:
        """The 21 low bits of a rank, three places apart."""
        x = rank & wp.int64(0x1FFFFF)
        x = (x | (x << wp.int64(32))) & wp.int64(0x1F00000000FFFF)
        x = (x | (x << wp.int64(16))) & wp.int64(0x1F0000FF0000FF)
        x = (x | (x << wp.int64(8))) & wp.int64(0x100F00F00F00F00F)
        x = (x | (x << wp.int64(4))) & wp.int64(0x10C30C30C30C30C3)
        return (x | (x << wp.int64(2))) & wp.int64(0x1249249249249249)

    @wp.kernel(module="unique", module_options=options)
    def morton_codes(first: int, ranks: wp.array2d(dtype=wp.int64), drop: int, codes: wp.array(dtype=wp.int64)):
        i = first + wp.tid()
        x = spread(ranks[0, i] >> wp.int64(drop))
        y = spread(ranks[1, i] >> wp.int64(drop))
        z = spread(ranks[2, i] >> wp.int64(drop))
        codes[i] = x | (y << wp.int64(1)) | (z << wp.int64(2))

    @wp.kernel(module="unique", module_options=options)
    def leaf_boxes(
        first: int,
        points: wp.array(dtype=wp.vec3d),
        leaf_count: int,
        lower: wp.array(dtype=wp.vec3d),
        upper: wp.array(dtype=wp.vec3d),
    ):
        leaf = first + wp.tid()
        # A leaf beyond the last point stays inside out: infinitely far from everything.
        low = wp.vec3d(wp.float64(wp.inf))
        high = wp.vec3d(wp.float64(-wp.inf))
        for i in range(leaf * leaf_size, wp.min((leaf + 1) * leaf_size, points.shape[0])):
            low = wp.min(low, points[i])
            high = wp.max(high, points[i])
        lower[leaf_count + leaf] = low
        upper[leaf_count + leaf] = high

    @wp.kernel(module="unique", module_options=options)
    def merge_boxes(first: int, lower: wp.array(dtype=wp.vec3d), upper: wp.array(dtype=wp.vec3d)):
        node = first + wp.tid()
        lower[node] = wp.min(lower[2 * node], lower[2 * node + 1])
        upper[node] = wp.max(upper[2 * node], upper[2 * node + 1])

    @wp.func
    def scan_leaf(leaf: int, i: int, points: wp.array(dtype=wp.vec3d), found: nearest_k) -> nearest_k:
        """The k smallest squared distances of `found` and the leaf's points, ascending."""
        best = found
        point = points[i]
        for j in range(leaf * leaf_size, wp.min((leaf + 1) * leaf_size, points.shape[0])):
            distance = wp.length_sq(points[j] - point)
            if j != i and distance < best[k - 1]:
                for slot in range(k):
                    if distance < best[slot]:
                        larger = best[slot]
                        best[slot] = distance
                        distance = larger
        return best

    @wp.kernel(module="unique", module_options=options)
    def nearest(
        first: int,
        points: wp.array(dtype=wp.vec3d),
        order: wp.array(dtype=wp.int64),
        lower: wp.array(dtype=wp.vec3d),
        upper: wp.array(dtype=wp.vec3d),
        leaf_count: int,
        distances: wp.array2d(dtype=wp.float64),
    ):
        i = first + wp.tid()
        point = points[i]
        own = i // leaf_size
        best = scan_leaf(own, i, points, nearest_k(wp.float64(wp.inf)))
        zero = wp.vec3d()
        climbed = leaf_count + own
        while climbed > 1:
            top = climbed ^ 1
            node = top
            while node > 0:
                gap = wp.max(wp.max(lower[node] - point, point - upper[node]), zero)
                near = wp.length_sq(gap) < best[k - 1]
                if near and node >= leaf_count:
                    best = scan_leaf(node - leaf_count, i, points, best)
                if near and node < leaf_count:
                    node = 2 * node
                else:
                    while node != top and (node & 1) == 1:
                        node = node >> 1
                    if node == top:
                        node = 0
                    else:
                        node += 1
            climbed = climbed >> 1
        for slot in range(k):
            distances[wp.int32(order[i]), slot] = wp.sqrt(best[slot])

    return SimpleNamespace(morton_codes=morton_codes, leaf_boxes=leaf_boxes, merge_boxes=merge_boxes, nearest=nearest)
