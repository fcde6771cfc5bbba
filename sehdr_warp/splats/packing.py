"""Helpers of compressed files of Gaussians: order in space, small codebooks, quaternions by three components."""

from warnings import catch_warnings, simplefilter

import numpy as np

CODES = 256
_ROUNDS = 12
_SQRT_HALF = np.sqrt(0.5)
_MOST = 1e15  # Harmonic whose square is well within float32, in which scipy measures distances
_STEPS = (1 << 21) - 1  # Of each axis of a Morton curve


def morton_order(means: np.ndarray) -> np.ndarray:
    """Return the index [N] that sorts points [N, 3] along a Morton curve: neighbors compress well.

    The curve runs over ranks rather than coordinates, so a few strays do not spoil it.
    """
    ranks = np.empty(means.shape, np.uint64)
    for axis in range(3):
        ranks[np.argsort(means[:, axis], kind="stable"), axis] = np.arange(len(means), dtype=np.uint64)
    return np.argsort(_morton_codes(ranks * np.uint64(_STEPS) // np.uint64(max(len(means) - 1, 1))), kind="stable")


def compact_order(means: np.ndarray) -> np.ndarray:
    """Return the index [N] that sorts points [N, 3] along a Morton curve of cubes: consecutive points are near.

    The curve runs over coordinates of one scale, so it is as good for flat scenes; the farthest hundredth is clipped.
    """
    low, high = np.quantile(means[:: max(1, len(means) // 100_000)], [0.005, 0.995], axis=0)
    size = max(float((high - low).max()), 1e-30)
    steps = np.clip((means.astype(np.float64) - low) / size, 0, 1) * _STEPS
    return np.argsort(_morton_codes(steps.astype(np.uint64)), kind="stable")


def _morton_codes(steps: np.ndarray) -> np.ndarray:
    """Return the codes [N] uint64 of which the bits of three numbers [N, 3] below 2^21 take turns."""
    code = np.zeros(len(steps), np.uint64)
    for axis in range(3):
        bits = steps[:, axis]
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


def codebook(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 256 float32 levels, ascending, and the uint8 code of each value (one-dimensional k-means)."""
    flat = np.sort(values.ravel().astype(np.float64))
    levels = np.quantile(flat, (np.arange(CODES) + 0.5) / CODES)
    # Half of the levels spread over the range: quantiles alone leave its ends coarse.
    levels[::2] = np.linspace(flat[0], flat[-1], CODES // 2)
    levels.sort()
    sums = np.concatenate([[0.0], np.cumsum(flat)])
    for _ in range(_ROUNDS):
        edges = np.searchsorted(flat, (levels[1:] + levels[:-1]) / 2)
        first, last = np.concatenate([[0], edges]), np.concatenate([edges, [len(flat)]])
        count = last - first
        levels = np.where(count > 0, (sums[last] - sums[first]) / np.maximum(count, 1), levels)
    levels = levels.astype(np.float32)
    codes = np.searchsorted((levels[1:] + levels[:-1]) / 2, values)
    return levels, codes.astype(np.uint8)


def palette(rows: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return [size, D] float32 rows and the label [N] of the nearest one for each of rows [N, D] (two-level k-means).

    Rows are split into groups first, and each group gets a share of the palette by its number of rows and their spread.
    """
    rows = np.clip(rows, -_MOST, _MOST, dtype=np.float32)
    groups = max(1, int(np.sqrt(size) / 2))
    _, group = _k_means(rows, groups)
    counts = np.bincount(group, minlength=groups)
    variance = np.array([rows[group == g].var(axis=0).sum() if n else 0 for g, n in enumerate(counts)])
    share = counts * np.sqrt(variance + 1e-12)
    sizes = np.minimum(np.floor(size * share / max(share.sum(), 1e-30)).astype(int), counts)
    sizes = np.where(counts > 0, np.maximum(sizes, 1), 0)
    while sizes.sum() > size:
        sizes[np.argmax(sizes)] -= 1
    centers, labels, start = np.zeros((size, rows.shape[1]), np.float32), np.zeros(len(rows), int), 0
    for g in np.nonzero(counts)[0]:
        members = np.nonzero(group == g)[0]
        part, inside = _k_means(rows[members], sizes[g])
        centers[start : start + sizes[g]] = part
        labels[members] = start + inside
        start += sizes[g]
    return centers, labels


def smallest_three(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index [N] of the largest component, and the others [N, 3] in their order, in [-1, 1].

    The sign is chosen so that the largest is positive; the others are divided by the square root of a half.
    """
    largest = np.abs(quaternions).argmax(axis=1)
    rows = np.arange(len(quaternions))
    signed = quaternions * np.where(quaternions[rows, largest] < 0, -1, 1)[:, None]
    keep = np.ones(quaternions.shape, bool)
    keep[rows, largest] = False
    return largest, signed[keep].reshape(-1, 3) / _SQRT_HALF


def from_smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return unit quaternions [N, 4] of what smallest_three returns."""
    rows = np.arange(len(largest))
    result = np.zeros((len(largest), 4))
    fill = np.ones(result.shape, bool)
    fill[rows, largest] = False
    result[fill] = (others * _SQRT_HALF).ravel()
    result[rows, largest] = np.sqrt(np.maximum(1 - (result**2).sum(axis=1), 0))
    return (result / np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def logits(opacities: np.ndarray) -> np.ndarray:
    """Return the logits of 8-bit opacities in [0, 1]; 0 and 1 count as a quarter of a step inside."""
    inside = np.clip(opacities.astype(np.float64), 0.25 / 255, 1 - 0.25 / 255)
    return np.log(inside / (1 - inside)).astype(np.float32)


def _k_means(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return [count, D] centers and labels [N]; rows [N, D], N >= count."""
    from scipy.cluster.vq import kmeans2

    start = rows[np.sort(np.random.default_rng(0).choice(len(rows), count, replace=False))]
    with catch_warnings():
        simplefilter("ignore")  # Of equal rows some clusters are empty.
        return kmeans2(rows, start, iter=_ROUNDS // 2 + 1, minit="matrix", check_finite=False)
