"""Distances to the nearest other points of a cloud (kernels/neighbours.py)."""

import torch
import warp as wp

from ..errors import SehdrError
from ..kernels.neighbours import LEAF_SIZE, RANK_BITS, neighbour_kernels
from . import threads
from .bridge import torch_stream


@torch.no_grad()
def nearest_neighbour_distances(points: torch.Tensor, k: int = 3) -> torch.Tensor:
    """Exact Euclidean distances from every point to the k nearest other points.

    points: [P, 3] float32 or float64, finite, on the CPU or a GPU; P from 0 to about 10^8. Duplicates count as other
    points, at distance 0.
    k: neighbours, from 1 to 32.

    Returns [P, k] in the points' type and unit, ascending. Where fewer than k other points exist (P <= k) the missing
    distances are infinite. Not differentiable.

    Raises SehdrError for a point that is not finite; ValueError for another shape, TypeError for another type.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have shape {list(points.shape)}, not [P, 3]")
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"points are {points.dtype}, not float32 or float64")
    if not 1 <= k <= 32:
        raise ValueError(f"k = {k} is outside 1 .. 32")
    finite = torch.isfinite(points).all(1)
    if not bool(finite.all()):
        index = int((~finite).nonzero()[0, 0])
        raise SehdrError(
            f"point {index} of {len(points)} is {points[index].tolist()}: a point cloud needs finite coordinates; "
            "remove such points"
        )
    count = len(points)
    distances = torch.full((count, k), torch.inf, dtype=torch.float64, device=points.device)
    if count < 2:
        return distances.to(points.dtype)
    # A power of two is an exact change of unit; in it no square overflows or vanishes.
    extent = float((points.amax(0).double() / 2 - points.amin(0).double() / 2).max())
    unit = 2.0 ** max(-1000, torch.tensor(extent, dtype=torch.float64).frexp().exponent.item()) if extent > 0 else 1.0
    with torch_stream(points.device):
        _search(points.double() / unit, distances)
    return (distances * unit).to(points.dtype)


def _search(points: torch.Tensor, distances: torch.Tensor) -> None:
    """Fill distances [P, k] for float64 points [P, 3]."""
    count, device = len(points), wp.device_from_torch(points.device)
    kernels = neighbour_kernels(distances.shape[1])

    def launch(kernel, first, total, *arguments):
        if device.is_cpu:
            ranges = [(first + a, first + b) for a, b in threads.even_ranges(total)]
            threads.launch_ranges(kernel, ranges, arguments, device)
        else:
            wp.launch(kernel, dim=total, inputs=[first, *arguments], device=device)

    ranks = torch.empty(3, count, dtype=torch.int64, device=points.device)
    ascending = torch.arange(count, device=points.device)
    for axis in range(3):
        ranks[axis, torch.argsort(points[:, axis], stable=True)] = ascending
    codes = torch.empty(count, dtype=torch.int64, device=points.device)
    drop = max(0, (count - 1).bit_length() - RANK_BITS)
    launch(kernels.morton_codes, 0, count, wp.from_torch(ranks), drop, wp.from_torch(codes))
    order = torch.argsort(codes, stable=True)
    ordered = points[order].contiguous()

    leaf_count = 1 << (-(-count // LEAF_SIZE) - 1).bit_length()
    lower, upper = torch.empty(2, 2 * leaf_count, 3, dtype=torch.float64, device=points.device)
    boxes = wp.from_torch(lower, dtype=wp.vec3d), wp.from_torch(upper, dtype=wp.vec3d)
    leaves = wp.from_torch(ordered, dtype=wp.vec3d)
    launch(kernels.leaf_boxes, 0, leaf_count, leaves, leaf_count, *boxes)
    level = leaf_count // 2
    while level:
        launch(kernels.merge_boxes, level, level, *boxes)
        level //= 2
    launch(kernels.nearest, 0, count, leaves, wp.from_torch(order), *boxes, leaf_count, wp.from_torch(distances))
