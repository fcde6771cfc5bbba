"""The coordinates that a scene is trained in: around its cameras, with the radius of the cameras as unit.

Sets come in metres, in arbitrary units of structure from motion, or in UTM coordinates. Learning rates, position noise
and float32 assume a world of about unit size at the origin, as gsplat's and nerfstudio's trainers do.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from .camera import Camera
from .types import Scene

MARGIN = 1.1  # The unit is this many radii of the training cameras (3DGS: `cameras_extent`)
POINT_SHARE = 0.1  # Cameras at one place: the unit is this part of the median distance of the points
LEAST_SPREAD = 1e-9
"""Cameras that are closer together than this part of their distance from the points count as one place."""


@dataclass(frozen=True)
class Normalization:
    """A similarity between scene coordinates and normalized coordinates: normalized = (scene - center) / unit."""

    center: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] float64, scene coordinates of its origin
    unit: float = 1.0  # Scene units per normalized unit, positive and finite

    def __post_init__(self) -> None:
        """Check the values; raise ValueError for a center that is not finite or a unit that is not positive."""
        center = np.array(self.center, dtype=np.float64)
        if center.shape != (3,) or not np.isfinite(center).all():
            raise ValueError("the center of a normalization is not three finite numbers")
        if not 0 < self.unit < np.inf:
            raise ValueError(f"the unit of a normalization is {self.unit}, not a positive number")
        center.setflags(write=False)
        object.__setattr__(self, "center", center)

    @property
    def is_identity(self) -> bool:
        """True if both coordinates are the same."""
        return self.unit == 1.0 and not self.center.any()

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return points [..., 3] of scene coordinates in normalized coordinates, float64."""
        return (np.asarray(points, np.float64) - self.center) / self.unit

    def scene_points(self, points: np.ndarray) -> np.ndarray:
        """Return points [..., 3] of normalized coordinates in scene coordinates, float64."""
        return np.asarray(points, np.float64) * self.unit + self.center

    def camera(self, camera: Camera) -> Camera:
        """Return a camera of scene coordinates in normalized coordinates."""
        if self.is_identity:
            return camera
        pose = camera.world_to_camera.copy()
        # Not R (center) + t: in UTM coordinates both are millions and their sum is not.
        pose[:3, 3] = -pose[:3, :3] @ self.points(camera.position)
        return replace(camera, world_to_camera=pose)

    def scene(self, scene: Scene) -> Scene:
        """Return a scene with its cameras and points in normalized coordinates; photos are shared."""
        if self.is_identity:
            return scene
        views = tuple(replace(view, camera=self.camera(view.camera)) for view in scene.views)
        return replace(scene, views=views, points=self.points(scene.points).reshape(-1, 3))

    def to_dict(self) -> dict:
        """Return plain values for JSON; from_dict reads them back exactly."""
        return {"center": self.center.tolist(), "unit": self.unit}

    @staticmethod
    def from_dict(values: dict) -> "Normalization":
        """Return the normalization that to_dict described."""
        return Normalization(np.array(values["center"]), float(values["unit"]))


def normalization_of(scene: Scene) -> Normalization:
    """Return the normalization that a scene is trained in.

    The origin is the mean position of the training cameras. The unit is 1.1 times the largest distance of one from it;
    for cameras at one place a tenth of the median distance to the points. All in float64.
    """
    positions = np.stack([view.camera.position for view in scene.train_views])
    center = positions.mean(0)
    radius = float(np.linalg.norm(positions - center, axis=1).max())
    distance = float(np.median(np.linalg.norm(scene.points - center, axis=1))) if len(scene.points) else 0.0
    if radius > LEAST_SPREAD * max(distance, float(np.abs(center).max())):
        return Normalization(center, MARGIN * radius)
    return Normalization(center, POINT_SHARE * distance if distance > 0 else 1.0)
