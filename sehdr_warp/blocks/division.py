"""Divide a set of photos by space into blocks, by what the photos show.

Each photo stands for the places that it shows: the points in its field of view, near ones with more weight. The places
of all photos are split in parts along their longest axis, and again (a k-d tree). The cells of the tree are the cores
of the blocks: they fill space without overlap. A block trains on every photo of which its core, enlarged by a margin,
fills a part that matters, so blocks share photos at their borders. The cuts are moved until blocks have about equal
numbers of photos, those at borders included: a block in the middle has more borders, and a smaller core.
VastGaussian (CVPR 2024) and CityGaussian (ECCV 2024) divide alike, but for the moves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..errors import InputError
from ..scene import Camera
from ..scene.photos import FEWEST_PHOTOS
from ..subsets import every_nth

MARGIN = 0.1  # Enlargement of a core for the choice of its photos, as a fraction of its extent, on each side
LEAST_PART = 0.15  # A block trains on photos of which its enlarged core fills at least this part
MAX_PART = 0.8  # If a block needs a larger part of all photos, dividing saves nothing
FEWEST_PLACES, MOST_PLACES, PLACES_PER_PHOTO = 20_000, 200_000, 20
"""Number of points that describe what photos show: PLACES_PER_PHOTO for each photo, within the first two bounds."""
MOST_OF_PHOTO = 4096  # Points that one photo is described by, so that 20,000 photos need 0.7 GB at most
MOVES = 12  # Divisions that are tried to find blocks of equal numbers of photos
LEAST_PHOTOS = max(FEWEST_PHOTOS, 6)  # Photos that a block needs at least


@dataclass(frozen=True)
class Cell:
    """An axis-aligned box in the axes of a division; bounds may be infinite."""

    low: np.ndarray  # [3] lower bounds
    high: np.ndarray  # [3] upper bounds

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
    """A division of space and photos."""

    axes: np.ndarray  # [3, 3] rows are the axes of the cells in scene coordinates, orthonormal
    cells: tuple[Cell, ...]  # Cores of the blocks, in these axes
    margins: np.ndarray  # [B, 3] enlargement of each core
    photos: tuple[np.ndarray, ...]  # Indices of the photos of each block, ascending

    def block_of(self, points: np.ndarray) -> np.ndarray:
        """Return the index [N] of the block whose core contains each of the points [N, 3] of scene coordinates."""
        places = np.asarray(points, np.float64) @ self.axes.T
        index = np.zeros(len(places), np.int64)
        for block, cell in enumerate(self.cells):
            index[cell.contains(places)] = block
        return index

    def enlarge(self, block: int) -> Cell:
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


@dataclass(frozen=True)
class ShownPlaces:
    """The places that V photos show."""

    points: np.ndarray  # [P, 3] points of scene coordinates
    # [V, P] sparse float32, the part of each photo that a point stands for; a row sums to 1, or to 0
    parts: sparse.csr_array
    middles: np.ndarray  # [V, 3] mean of the points of each photo; of a photo without points, the place of its camera

    @staticmethod
    def of(cameras: Sequence[Camera], points: np.ndarray) -> "ShownPlaces":
        """Describe photos by some of the points [P, 3] of what they show."""
        points = thin_out(np.asarray(points, np.float64), len(cameras))
        columns, values = [], []
        for camera in cameras:
            weights = weights_of(camera, points)
            inside = np.flatnonzero(weights)
            inside = every_nth(inside, MOST_OF_PHOTO)
            columns.append(inside.astype(np.int32))
            values.append((weights[inside] / max(weights[inside].sum(), 1e-300)).astype(np.float32))
        ends = np.cumsum([0, *map(len, columns)])
        parts = sparse.csr_array(
            (np.concatenate(values), np.concatenate(columns), ends), shape=(len(cameras), len(points))
        )
        middles = parts @ points
        blind = np.diff(ends) == 0
        middles[blind] = np.array([camera.position for camera in cameras]).reshape(-1, 3)[blind]
        return ShownPlaces(points, parts, middles)


def thin_out(points: np.ndarray, photos: int) -> np.ndarray:
    """Return every nth of points [P, 3], enough to describe a number of photos."""
    most = min(max(FEWEST_PLACES, PLACES_PER_PHOTO * photos), MOST_PLACES)
    return every_nth(points, most)


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
    return _divide(name, ShownPlaces.of(cameras, points), count)


def largest_count(name: str, cameras: Sequence[Camera], points: np.ndarray, most: int) -> Division | None:
    """Return the division into `most` blocks, or into the largest smaller number that is possible; None for none."""
    places = ShownPlaces.of(cameras, points)
    for count in range(min(most, len(cameras) // LEAST_PHOTOS), 1, -1):
        try:
            return _divide(name, places, count)
        except InputError:
            continue
    return None


def _divide(name: str, coverage: ShownPlaces, count: int) -> Division:
    """Return the division whose largest block has the fewest photos, of those that moving the cuts gives."""
    axes = _principal_axes(coverage.middles)
    best, shares = None, np.full(count, 1 / count)
    for _ in range(MOVES):
        try:
            division = _cut(name, coverage, axes, shares)
        except InputError:
            if best is None:
                raise
            break
        sizes = np.array([len(own) for own in division.photos])
        if best is None or sizes.max() < max(map(len, best.photos)):
            best = division
        if np.ptp(sizes) <= 1:
            break
        shares *= np.sqrt(sizes.mean() / np.maximum(sizes, 1))
        shares /= shares.sum()
    assert best is not None
    _check(name, best.photos, len(coverage.middles), count)
    return best


def _cut(name: str, coverage: ShownPlaces, axes: np.ndarray, shares: np.ndarray) -> Division:
    """Divide photos into blocks whose cores hold fractions `shares` of the photos' middles."""
    middles, places = coverage.middles @ axes.T, coverage.points @ axes.T
    cells = _split(name, middles, Cell(np.full(3, -np.inf), np.full(3, np.inf)), shares)
    low, high = np.quantile(places, [0.02, 0.98], axis=0)
    margins = np.stack([MARGIN * _extent(cell, low, high) for cell in cells])
    enlarged = [Cell(cell.low - margin, cell.high + margin) for cell, margin in zip(cells, margins, strict=True)]
    inside = np.stack([cell.contains(places) for cell in enlarged], axis=1).astype(np.float32)  # [P, B]
    own = np.stack([cell.contains(middles) for cell in cells], axis=1)
    members = (coverage.parts @ inside >= LEAST_PART) | own
    return Division(axes, tuple(cells), margins, tuple(np.flatnonzero(column) for column in members.T))


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


def _split(name: str, places: np.ndarray, cell: Cell, shares: np.ndarray) -> list[Cell]:
    """Split a cell with places [N, 3] into cells with stated shares of the places; the shares [B] need no sum.

    Raises:
        InputError: If many places are the same.
    """
    count = len(shares)
    if count == 1:
        return [cell]
    low, high = np.quantile(places, [0.05, 0.95], axis=0)
    axis, first = int(np.argmax(high - low)), count // 2
    at = float(np.quantile(places[:, axis], shares[:first].sum() / shares.sum()))
    below = places[:, axis] < at
    if below.sum() < first or (~below).sum() < count - first:
        problem = f"{len(places)} training photos cannot be divided into {count} blocks: many show the same place"
        raise InputError(name, problem, "use fewer blocks, or train without --blocks")
    near, far = cell.halves(axis, at)
    parts = (places[below], near, shares[:first]), (places[~below], far, shares[first:])
    return [each for part in parts for each in _split(name, *part)]


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
