"""Divide a set of photos by space into blocks, by what the photos show.

Each photo stands for the places that it shows: the points in its field of view, near ones with more weight. The places
of all photos are split in halves along their longest axis, and again (a k-d tree), so that blocks have about equal
numbers of photos. The cells of the tree are the cores of the blocks: they fill space without overlap. A block trains on
every photo of which its core, enlarged by a margin, fills a part that matters, so blocks share photos at their borders.
VastGaussian (CVPR 2024) and CityGaussian (ECCV 2024) divide alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..scene import Camera
from ..scene.photos import FEWEST_PHOTOS

MARGIN = 0.1  # Enlargement of a core for the choice of its photos, as a fraction of its extent, on each side
LEAST_PART = 0.15  # A block trains on photos of which its enlarged core fills at least this part
MAX_PART = 0.8  # If a block needs a larger part of all photos, dividing saves nothing
MOST_PLACES = 20_000  # Points that photos are described by
LEAST_PHOTOS = max(FEWEST_PHOTOS, 6)  # Photos that a block needs at least


@dataclass(frozen=True)
class Cell:
    """An axis-aligned box in the axes of a division; bounds may be infinite.

    Attributes:
        low: [3] lower bounds.
        high: [3] upper bounds.
    """

    low: np.ndarray
    high: np.ndarray

    def contains(self, places: np.ndarray) -> np.ndarray:
        """Return whether the cell contains places [..., 3]: a bool [...]; its lower faces belong to it."""
        return np.all((places >= self.low) & (places < self.high), axis=-1)

    def halves(self, axis: int, at: float) -> tuple["Cell", "Cell"]:
        """Return the two parts of the cell below and above a plane."""
        low, high = self.low.copy(), self.high.copy()
        low[axis] = high[axis] = at
        return Cell(self.low, high), Cell(low, self.high)


@dataclass(frozen=True)
class Division:
    """A division of space and photos.

    Attributes:
        axes: [3, 3] rows are the axes of the cells in scene coordinates, orthonormal.
        cells: Cores of the blocks, in these axes.
        margins: [B, 3] enlargement of each core.
        photos: Indices of the photos of each block, ascending.
    """

    axes: np.ndarray
    cells: tuple[Cell, ...]
    margins: np.ndarray
    photos: tuple[np.ndarray, ...]

    def block_of(self, points: np.ndarray) -> np.ndarray:
        """Return the index [N] of the block whose core contains each of the points [N, 3] of scene coordinates."""
        places = np.asarray(points, np.float64) @ self.axes.T
        index = np.zeros(len(places), np.int64)
        for block, cell in enumerate(self.cells):
            index[cell.contains(places)] = block
        return index

    def enlarged(self, block: int) -> Cell:
        """Return the core of a block with its margin."""
        cell, margin = self.cells[block], self.margins[block]
        return Cell(cell.low - margin, cell.high + margin)

    def border_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance [N] from points [N, 3] of scene coordinates to the nearest face between two cores."""
        places = np.asarray(points, np.float64) @ self.axes.T
        distance = np.full(len(places), np.inf)
        for cell in self.cells:
            for face in (cell.low, cell.high):
                for axis in np.flatnonzero(np.isfinite(face)):
                    beside = np.maximum(np.maximum(cell.low - places, places - cell.high), 0)
                    beside[:, axis] = np.abs(places[:, axis] - face[axis])
                    distance = np.minimum(distance, np.linalg.norm(beside, axis=1))
        return distance


def divide(name: str, cameras: Sequence[Camera], points: np.ndarray, count: int) -> Division:
    """Divide photos into blocks.

    Args:
        name: Of the set, for errors.
        cameras: Of the training photos.
        points: [P, 3] points of what they show, scene coordinates.
        count: Number of blocks, at least 2.

    Raises:
        InputError: If a block would have too few photos, or nearly all of them.
    """
    if len(cameras) < count * LEAST_PHOTOS:
        most = len(cameras) // LEAST_PHOTOS
        problem = f"{len(cameras)} training photos are too few for {count} blocks of at least {LEAST_PHOTOS}"
        remedy = f"use --blocks {most} at most" if most > 1 else "train without --blocks"
        raise InputError(name, problem, remedy)
    points = np.asarray(points, np.float64)
    points = points[:: -(-len(points) // MOST_PLACES) or 1]
    weights = np.stack([weights_of(camera, points) for camera in cameras])  # [V, P], each row sums to 1 or 0
    blind = np.flatnonzero(weights.sum(1) == 0)
    middles = weights @ points
    middles[blind] = np.array([camera.position for camera in cameras]).reshape(-1, 3)[blind]
    axes = _principal_axes(middles)
    cells = _split(name, middles @ axes.T, Cell(np.full(3, -np.inf), np.full(3, np.inf)), count)
    places = points @ axes.T
    low, high = np.quantile(places, [0.02, 0.98], axis=0)
    margins = np.stack([MARGIN * _extent(cell, low, high) for cell in cells])
    enlarged = [Cell(cell.low - margin, cell.high + margin) for cell, margin in zip(cells, margins, strict=True)]
    parts = np.stack([weights @ cell.contains(places) for cell in enlarged], axis=1)  # [V, B]
    own = np.stack([cell.contains(middles @ axes.T) for cell in cells], axis=1)
    members = (parts >= LEAST_PART) | own
    photos = tuple(np.flatnonzero(column) for column in members.T)
    _check(name, photos, len(cameras), count)
    return Division(axes, tuple(cells), margins, photos)


def largest_count(name: str, cameras: Sequence[Camera], points: np.ndarray, most: int) -> Division | None:
    """Return the division into `wanted` blocks, or into the largest smaller number that is possible; None for none."""
    for count in range(most, 1, -1):
        try:
            return divide(name, cameras, points, count)
        except InputError:
            continue
    return None


def weights_of(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the part [P] of a photo that each point stands for: more for near ones, 0 outside; occlusion is ignored.

    Sparse points are about as dense in every photo, but far ones are also inside of photos that do not show them.
    """
    distance = np.linalg.norm(points - camera.position, axis=1)
    inside = distance > 0
    if camera.is_pinhole:
        inside &= camera.project(points).inside
    weights = np.where(inside, 1 / np.maximum(distance, 1e-9), 0.0)
    return weights / weights.sum() if inside.any() else weights


def _principal_axes(places: np.ndarray) -> np.ndarray:
    """Return the principal axes [3, 3] of places [N, 3] as rows, the longest first; a right-handed frame."""
    centered = places - np.median(places, axis=0)
    axes = np.linalg.eigh(centered.T @ centered).eigenvectors.T[::-1].copy()
    axes *= np.where(np.take_along_axis(axes, np.abs(axes).argmax(1)[:, None], 1) < 0, -1, 1)
    axes[2] = np.cross(axes[0], axes[1])
    return axes


def _split(name: str, places: np.ndarray, cell: Cell, count: int) -> list[Cell]:
    """Split a cell with places [N, 3] into `count` cells with about equal numbers of places.

    Raises:
        InputError: If many places are the same.
    """
    if count == 1:
        return [cell]
    low, high = np.quantile(places, [0.05, 0.95], axis=0)
    axis, first = int(np.argmax(high - low)), count // 2
    at = float(np.quantile(places[:, axis], first / count))
    below = places[:, axis] < at
    if below.sum() < first or (~below).sum() < count - first:
        problem = f"{len(places)} training photos cannot be divided into {count} blocks: many show the same place"
        raise InputError(name, problem, "use fewer blocks, or train without --blocks")
    near, far = cell.halves(axis, at)
    return _split(name, places[below], near, first) + _split(name, places[~below], far, count - first)


def _extent(cell: Cell, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the size [3] of the part of a cell between two corners [3]."""
    return np.maximum(np.minimum(cell.high, high) - np.maximum(cell.low, low), 0.0)


def _check(name: str, photos: tuple[np.ndarray, ...], total: int, count: int) -> None:
    """Raise InputError for blocks with too few photos, or with nearly all photos of the set."""
    for block, own in enumerate(photos):
        if len(own) < LEAST_PHOTOS:
            problem = f"block {block + 1} of {count} would have {len(own)} photos, less than {LEAST_PHOTOS}"
            remedy = f"use --blocks {count - 1}" if count > 2 else "train without --blocks"
            raise InputError(name, problem, remedy)
    largest = max(len(own) for own in photos)
    if largest > MAX_PART * total:
        problem = f"cannot be divided into {count} blocks: one of them is in {largest} of the {total} training photos"
        raise InputError(name, problem, "train without --blocks; photos must show different places to be divided")
