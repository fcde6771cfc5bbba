"""The camera that every part of the package shares: a pinhole, a panorama or a fisheye lens."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import require_number, require_whole_number
from ..json_values import json_object, number, numbers, text, whole_number

FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE")
"""COLMAP's fisheye models that are radial."""
PROJECTIONS = ("pinhole", "equirectangular", *FISHEYES)
_DISTORTIONS = {"OPENCV_FISHEYE": 4, "RADIAL_FISHEYE": 2, "SIMPLE_RADIAL_FISHEYE": 1}
"""Number of parameters behind the principal point, where there are any."""
MAX_SIDE = 1 << 20  # Pixels of a side of an image that can be rendered
MIN_FOCAL, MAX_FOCAL = 1e-3, 1e9  # Pixels of a focal length; beyond them single precision cannot project
_PARALLEL = 1e-9  # Sine of the least angle between up and the direction of view
MAX_DISTANCE = 1e18  # Length of the translation of a pose, whose square a float32 must hold


def limited_size(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """Return the size scaled down, with the same aspect, to at most max_size pixels on its longest side."""
    scale = 1.0 if max_size is None else min(1.0, max_size / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def look_at(position: ArrayLike, target: ArrayLike = (0.0, 0.0, 0.0), up: ArrayLike = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Return the world_to_camera matrix [4, 4] of a camera at `position` that looks at `target`.

    Its image is upright with respect to `up`, which must not be parallel to the direction of view.

    Raises:
        ValueError: for other than three finite numbers, a target at the position, or a parallel `up`.
    """
    points = {"position": position, "target": target, "up": up}
    for name, point in points.items():
        if not _are_numbers(point, (3,)):
            raise ValueError(f"{name} is {point!r:.60}, expected three finite numbers")
    position = np.asarray(position, float)
    forward = np.subtract(target, position)
    if not np.linalg.norm(forward) > 0:
        raise ValueError(f"target is the position, {position.tolist()}; look at another point")
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, float))
    if not np.linalg.norm(right) > _PARALLEL * np.linalg.norm(up):
        raise ValueError(f"up {np.asarray(up, float).tolist()} is parallel to the direction of view; give another")
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _are_numbers(value: Any, shape: tuple[int, ...]) -> bool:
    """Return whether a value is an array, or lists, of finite numbers of a shape."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError):  # Ragged lists, or a tensor of a GPU or with a gradient
        return False
    return array.dtype.kind in "iuf" and array.shape == shape and bool(np.isfinite(array).all())


class ProjectedPoints(NamedTuple):
    """Pixels that points fall on."""

    row: np.ndarray  # [P] float64 whole numbers, NaN behind the camera
    column: np.ndarray  # [P] likewise
    depth: np.ndarray  # [P] along the camera's axis, NaN behind the camera
    inside: np.ndarray  # [P] bool, whether the picture contains the point


@dataclass(frozen=True, repr=False)
class Camera:
    """A camera in COLMAP's (OpenCV's) convention: +x right, +y down, +z into the scene.

    For a pinhole, a world point X lands at pixel (fx x/z + cx, fy y/z + cy) with (x, y, z) = (world_to_camera @ [X,
    1])[:3]; the centre of the top left pixel is at (0.5, 0.5).

    Attributes:
        width: of the image in pixels, at least 1.
        height: of the image in pixels, at least 1.
        fx: horizontal focal length in pixels, positive.
        fy: vertical focal length in pixels, positive.
        cx: column of the principal point in pixels.
        cy: row of the principal point in pixels.
        world_to_camera: [4, 4] float64, rigid.
        projection: "pinhole"; "equirectangular", of the whole sphere with the camera's axis in the middle; or a fisheye
            model of COLMAP, of a lens too wide for a pinhole. Others than pinholes look along the directions of
            wide_camera.pixel_directions(), and fx is their pixels per radian at the axis.
        distortion: the fisheye model's parameters behind the principal point.

    Raises:
        ValueError: if a size or focal length is out of range, a value is not finite, the pose is not rigid, or the
            projection has another number of distortion parameters.
        TypeError: for a size, length or center that is not a number.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray
    projection: str = "pinhole"
    distortion: tuple[float, ...] = ()

    def __post_init__(self):
        """Check the values, copy the pose, and make Python's numbers of those of arrays and tensors."""
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not hasattr(value, "__float__") or getattr(value, "shape", ()):
                raise TypeError(f"{name} is {value!r:.60}, expected a number")
            if not isinstance(value, int | float):
                object.__setattr__(self, name, float(value))
        pose = self.world_to_camera
        if hasattr(pose, "detach"):  # A tensor, perhaps with a gradient or of a GPU
            pose = pose.detach().cpu().numpy()  # pyright: ignore[reportAttributeAccessIssue]
        if not _are_numbers(pose, (4, 4)):
            raise ValueError("world_to_camera is not a finite 4 x 4 matrix")
        pose = np.array(pose, dtype=np.float64)
        pose.setflags(write=False)
        object.__setattr__(self, "world_to_camera", pose)
        if self.width % 1 or self.height % 1:  # True for NaN and infinity, too
            raise ValueError(f"image size {self.width} x {self.height} is not in whole pixels")
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size {self.width} x {self.height} is not positive")
        if max(self.width, self.height) > MAX_SIDE:
            raise ValueError(f"image size {self.width} x {self.height} is more than {MAX_SIDE} pixels on a side")
        if not np.isfinite(self.intrinsics).all():
            raise ValueError(f"camera fx, fy, cx, cy = {self.intrinsics.tolist()} are not finite")
        if self.projection not in PROJECTIONS:
            raise ValueError(f"projection {self.projection!r:.40} is not one of {', '.join(PROJECTIONS)}")
        count = _DISTORTIONS.get(self.projection, 0)
        if not _are_numbers(self.distortion, (count,)):
            problem = f"distortion is {self.distortion!r:.60}, expected {count} finite numbers"
            raise ValueError(f"{problem}, as {self.projection} has")
        object.__setattr__(self, "distortion", tuple(map(float, self.distortion)))
        if self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"focal lengths ({self.fx}, {self.fy}) are not positive")
        if min(self.fx, self.fy) < MIN_FOCAL or max(self.fx, self.fy) > MAX_FOCAL:
            problem = f"focal lengths ({self.fx:g}, {self.fy:g}) pixels are not between {MIN_FOCAL:g} and {MAX_FOCAL:g}"
            raise ValueError(problem)
        if max(abs(self.cx), abs(self.cy)) > MAX_FOCAL:
            raise ValueError(f"cx, cy = {self.cx:g}, {self.cy:g} are beyond {MAX_FOCAL:g} pixels")
        if np.abs(pose[:3, 3]).max() > MAX_DISTANCE:
            raise ValueError(f"world_to_camera moves by more than {MAX_DISTANCE:g}")
        rotation = pose[:3, :3]
        if np.abs(rotation).max() > 2 or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise ValueError("the rotation of world_to_camera is not a proper rotation")
        if np.linalg.det(rotation) < 0:
            raise ValueError("the rotation of world_to_camera is not a proper rotation")
        if not np.allclose(pose[3], (0, 0, 0, 1)):
            raise ValueError("the last row of world_to_camera is not (0, 0, 0, 1)")

    def __repr__(self) -> str:
        """Return size, focal length, position and projection in one line."""
        kind = "" if self.is_pinhole else f", {self.projection}"
        position = ", ".join(f"{value:.4g}" for value in self.position)
        return f"Camera({self.width} x {self.height}, focal length {self.fx:.5g} pixels, at ({position}){kind})"

    @property
    def pixel_count(self) -> int:
        """Number of pixels of the image."""
        return self.width * self.height

    @property
    def is_pinhole(self) -> bool:
        """True if pixels are on a plane in front of the camera."""
        return self.projection == "pinhole"

    @property
    def camera_to_world(self) -> np.ndarray:
        """The inverse [4, 4] of world_to_camera, float64."""
        inverse = np.eye(4)
        inverse[:3, :3] = self.world_to_camera[:3, :3].T
        inverse[:3, 3] = self.position
        return inverse

    @property
    def position(self) -> np.ndarray:
        """The camera's centre [3] in world coordinates, float64."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy in pixels, float64 [4]."""
        return np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float64)

    def project(self, points: np.ndarray) -> ProjectedPoints:
        """Return the pixels of a pinhole camera that world points [P, 3] fall on; occlusion is not considered."""
        local = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        depth = np.where(local[:, 2] > 1e-9, local[:, 2], np.nan)
        with np.errstate(invalid="ignore"):
            column = np.floor(self.fx * local[:, 0] / depth + self.cx)
            row = np.floor(self.fy * local[:, 1] / depth + self.cy)
            inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        return ProjectedPoints(row, column, depth, inside)

    def unproject(self, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return the world points [P, 3] of a pinhole camera at positions x, y [P] in pixels and depths [P]."""
        local = np.stack([(x - self.cx) / self.fx, (y - self.cy) / self.fy, np.ones_like(x)], 1) * depth[:, None]
        return local @ self.world_to_camera[:3, :3] + self.position

    def resized(self, width: int, height: int) -> "Camera":
        """Return the same view at another size; principal point and focal lengths scale with each axis."""
        require_number(width, "width")
        require_number(height, "height")
        sx, sy = width / self.width, height / self.height
        scaled = {"fx": self.fx * sx, "fy": self.fy * sy, "cx": self.cx * sx, "cy": self.cy * sy}
        return replace(self, width=width, height=height, **scaled)

    def within(self, max_size: int | None) -> "Camera":
        """Return the same view with at most max_size pixels on its longest side; None keeps its size."""
        if max_size is not None:
            require_whole_number(max_size, "max_size", 1)
        return self.resized(*limited_size(self.width, self.height, max_size))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, which from_dict reads back exactly."""
        names = ("width", "height", "fx", "fy", "cx", "cy")
        values = {name: getattr(self, name) for name in names} | {"world_to_camera": self.world_to_camera.tolist()}
        wide = {"projection": self.projection, "distortion": list(self.distortion)}
        return values if self.projection == "pinhole" else values | wide

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "Camera":
        """Return the camera that to_dict described.

        Raises:
            KeyError: if a field is missing.
            ValueError: if a value is not possible, or the values are not an object.
        """
        values = json_object(values, "the camera")
        width, height = (whole_number(values, name) for name in ("width", "height"))
        fx, fy, cx, cy = (number(values, name) for name in ("fx", "fy", "cx", "cy"))
        pose = numbers(values, "world_to_camera", 4, 4)
        distortion = tuple(numbers(values, "distortion", -1).tolist()) if "distortion" in values else ()
        return Camera(width, height, fx, fy, cx, cy, pose, text(values, "projection", "pinhole"), distortion)


def require_camera(camera: object) -> None:
    """Raise TypeError for what is not a Camera, such as an entry of run.cameras."""
    if not isinstance(camera, Camera):
        raise TypeError(f"camera is a {type(camera).__name__}, expected a Camera, as run.cameras[0].camera is one")
