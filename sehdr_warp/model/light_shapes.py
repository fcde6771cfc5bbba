"""Shapes of lights: the rectangle or sphere of a group of Gaussians, and the solid angles that points see of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..scene import Camera

REACH = 3.0  # Gaussians join one light if they are nearer than this many median standard deviations
LONG = 1.5  # Median standard deviations from which a Gaussian reaches further along its longest axis
ROUNDNESS = 0.4  # Ratio of the two larger variances below which a light is no ball, whatever its depth
FLATNESS = 0.15  # Ratio of variances below which a light is flat, or thin; the half of a ball that photos show has 0.22
LEAST_SIDE = 0.3  # Sine of the angle between a long Gaussian and the line to the cameras, below which these see its end


@dataclass(frozen=True, eq=False)
class LightShape:
    """A rectangle or a sphere, in the scene's coordinates."""

    kind: str  # "rect" or "sphere"
    position: np.ndarray  # [3] middle
    axes: np.ndarray  # [3, 3] rows: along the width, along the height, and the direction that a rectangle emits to
    size: tuple[float, float]  # Width and height of a rectangle; the diameter of a sphere, twice

    def with_area(self, factor: float) -> "LightShape":
        """Return the shape with a multiple of its area; of a thin rectangle the width stays, up to a square."""
        width, height = self.size
        if height**2 < FLATNESS * width**2:
            width = max(width, float(np.sqrt(factor * width * height)))
            return replace(self, size=(width, factor * self.size[0] * height / width))
        return replace(self, size=(width * factor**0.5, height * factor**0.5))

    def surrounds(self, point: np.ndarray) -> bool:
        """Return whether a point lies within a sphere."""
        return self.kind == "sphere" and float(np.linalg.norm(point - self.position)) < self.size[0] / 2

    def solid_angle(self, point: np.ndarray) -> float:
        """Return the solid angle that a point sees of a light; 0 from behind a rectangle, 2 pi within a sphere."""
        towards = self.axes @ (point - self.position)
        if self.kind == "sphere":
            sine = min(self.size[0] / 2 / max(float(np.linalg.norm(towards)), 1e-12), 1.0)
            return float(2 * np.pi * sine**2 / (1 + np.sqrt(1 - sine**2)))
        if towards[2] <= 0:
            return 0.0
        u, v = (towards[i] + np.array([0.5, -0.5]) * self.size[i] for i in (0, 1))
        corners = np.arctan2(np.outer(u, v), towards[2] * np.sqrt(u[:, None] ** 2 + v**2 + towards[2] ** 2))
        return float(corners[0, 0] - corners[0, 1] - corners[1, 0] + corners[1, 1])


def solid_angles(shape: LightShape, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the solid angles [V] that cameras see of a light."""
    return np.array([shape.solid_angle(camera.position) for camera in cameras])


def connected_groups(positions: np.ndarray, longest: np.ndarray) -> list[np.ndarray]:
    """Return the connected groups of Gaussians that are near to each other, as indices.

    Args:
        positions: [K, 3] centers.
        longest: [K, 3] longest axes, as long as their standard deviations. Gaussians count at their centers and long
            ones halfway along these to both sides, too: few make a strip.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    lengths = np.linalg.norm(longest, axis=1)
    median = float(np.median(lengths))
    long = np.flatnonzero(lengths > LONG * median)
    points = np.concatenate([positions, positions[long] + longest[long] / 2, positions[long] - longest[long] / 2])
    owners = np.concatenate([np.arange(len(positions)), long, long])
    pairs = owners[KDTree(points).query_pairs(REACH * median, output_type="ndarray")]
    links = coo_matrix((np.ones(len(pairs)), pairs.T), (len(positions), len(positions)))
    count, labels = connected_components(links, directed=False)
    return [np.flatnonzero(labels == label) for label in range(count)]


def fitted_shape(positions: np.ndarray, axes: np.ndarray, weights: np.ndarray, viewer: np.ndarray) -> LightShape:
    """Return the rectangle or sphere with the weighted mean and variances of Gaussians.

    A rectangle emits to the side of `viewer` [3]. A thin one, such as a tube or a strip, whose Gaussians are as wide as
    it is, faces that point, and so does an oblong of uncertain depth, such as a window joined with what is behind it.
    If long Gaussians that point there make it thin, it is a sphere: photos show their ends.

    Args:
        positions: [K, 3] centers.
        axes: [K, 3, 3] rows: principal axes, as long as their standard deviations.
        weights: [K].
        viewer: [3].
    """
    weights = weights / weights.sum()
    position = weights @ positions
    offsets = positions - position
    of_centers, own = (offsets * weights[:, None]).T @ offsets, np.einsum("k,kia,kib->ab", weights, axes, axes)
    longest = float(weights @ (axes**2).sum(2).max(1))
    values, vectors = (part[..., ::-1].T for part in np.linalg.eigh(of_centers))
    distance = float(np.linalg.norm(viewer - position))
    is_resolved = 2 * values[1] > longest
    if is_resolved and values[2] < FLATNESS * np.sqrt(max(values[0] * values[1], 0.0)):
        normal = vectors[2] if vectors[2] @ (viewer - position) >= 0 else -vectors[2]
    else:
        is_oblong = is_resolved and values[1] < ROUNDNESS * values[0] and 12 * values[0] < distance**2
        if not is_oblong:
            values, vectors = (part[..., ::-1].T for part in np.linalg.eigh(of_centers + own))
        normal = viewer - position - ((viewer - position) @ vectors[0]) * vectors[0]
        length = float(np.linalg.norm(normal))
        is_end = length < LEAST_SIDE * distance and 2 * vectors[0] @ own @ vectors[0] > values[0]
        if is_end or (not is_oblong and values[1] > FLATNESS * values[0]):
            diameter = 2 * float(np.sqrt(values.sum()))
            return LightShape("sphere", position, np.eye(3), (diameter, diameter))
        normal = normal / length if length > 0 else vectors[2]
    sides = np.stack([vectors[0], np.cross(normal, vectors[0]), normal])
    # A Gaussian reaches beyond its center on the light's face.
    width, height = (float(np.sqrt(12 * side @ (of_centers + own) @ side)) for side in sides[:2])
    return LightShape("rect", position, sides, (width, height))


def fit_solid_angles(shape: LightShape, received: np.ndarray, places: Sequence[np.ndarray]) -> np.ndarray:
    """Return the values [C] whose products with a shape's solid angles are what views at places receive [V, C].

    By least squares: the radiance of light, or the area of a solid angle as a multiple of the shape's.
    """
    angles = np.array([shape.solid_angle(place) for place in places])
    square = angles @ angles
    return angles @ received / square if square > 0 else np.zeros(received.shape[1])
