"""Cameras that no pinhole stands for: panoramas of the whole sphere, and fisheye lenses wider than a plane can show.

Their pixels look along directions. A panorama's pixels cover less and less of the sphere towards its poles, so each
counts by its solid angle. What compares photos by pinhole cameras (matching points, structure from motion) sees views
that are cut from them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .camera import Camera
from .types import View, codes_of

FACE_ANGLE = 90.0  # Degrees that a view cut from a wide photo shows
_LEAST_FILLED = 0.3  # Part of a cut view that its photo must show
_COARSE = 64  # Pixels across a face of which only the camera is used
WIDEST_PINHOLE = 110.0
"""Degrees: a fisheye lens that sees more keeps its own projection. Undistorted to a pinhole, its border would be lost
or stretched."""


def pixel_directions(camera: Camera) -> np.ndarray:
    """Return [H, W, 3] float64 unit vectors along which pixels look, camera axes; NaN where the lens shows nothing."""
    return _directions(camera.width, camera.height, camera.projection, tuple(camera.intrinsics), camera.distortion)


def pixel_rays(camera: Camera) -> np.ndarray:
    """Return [H, W, 3] float64 rays in camera axes that, times a render's depths, lead from camera to surface.

    Those of a pinhole are 1 long along its axis, as depths are measured along it. Those of a wide camera are unit
    vectors, as its depths are distances; 0 where its lens shows nothing.
    """
    if not camera.is_pinhole:
        return np.nan_to_num(pixel_directions(camera))
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=2)


def surface_points(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return world points [H, W, 3] at the depths [H, W] of a render."""
    return (pixel_rays(camera) * depth[..., None]) @ camera.world_to_camera[:3, :3] + camera.position


@lru_cache(maxsize=4)
def _directions(width: int, height: int, projection: str, intrinsics: tuple, distortion: tuple) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    if projection == "equirectangular":
        across, up = (columns / width - 0.5) * 2 * np.pi, (0.5 - rows / height) * np.pi
        parts = np.sin(across) * np.cos(up), -np.sin(up), np.cos(across) * np.cos(up)
        return np.stack(parts, axis=2)
    fx, fy, cx, cy = intrinsics
    if projection == "pinhole":
        rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=2)
        return rays / np.linalg.norm(rays, axis=2, keepdims=True)
    return _fisheye_directions(projection, (columns - cx) / fx, (rows - cy) / fy, distortion)


def _fisheye_directions(projection: str, x: np.ndarray, y: np.ndarray, distortion: tuple) -> np.ndarray:
    """Return the directions of normalized fisheye coordinates: theta_d (cos, sin) of a radial polynomial.

    pycolmap returns x / z and y / z, which end at 90 degrees from the axis; a fisheye lens goes on.
    """
    radius = np.hypot(x, y)
    angle = fisheye_angles(projection, distortion, radius)
    scale = np.where(radius > 1e-12, np.sin(angle) / np.maximum(radius, 1e-12), 1.0)
    return np.stack([x * scale, y * scale, np.cos(angle)], axis=2)


def fisheye_angles(projection: str, distortion: tuple, radius: np.ndarray) -> np.ndarray:
    """Return the angles from the axis, radians, that a fisheye lens shows at radii in focal lengths; NaN beyond."""
    theta = np.linspace(0, np.pi, 8192)
    bent = _fisheye_radii(projection, distortion, theta)
    visible = np.isfinite(bent)
    return np.interp(radius, bent[visible], theta[visible], right=np.nan)


def _fisheye_radii(projection: str, distortion: tuple, theta: np.ndarray) -> np.ndarray:
    """Return theta_d(theta), radii in focal lengths; NaN from its first maximum on, behind which nothing is seen."""
    counts = {"OPENCV_FISHEYE": 4, "SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2}
    model = np.polynomial.Polynomial([0.0, 1.0])
    for power, term in enumerate(distortion[: counts.get(projection, 0)], 1):
        model += np.polynomial.Polynomial([0.0] * (2 * power + 1) + [term])
    maxima = [root.real for root in model.deriv().roots() if abs(root.imag) < 1e-9 and root.real > 0]
    return np.where(theta < min(maxima, default=np.inf), model(theta), np.nan)


def solid_angles(camera: Camera) -> np.ndarray:
    """Return [H, W] float32 solid angles of the pixels, 1 for the largest; 0 where the lens shows nothing."""
    angles = steradians(camera)
    return (angles / max(float(angles.max()), 1e-12)).astype(np.float32)


def steradians(camera: Camera) -> np.ndarray:
    """Return [H, W] float64 solid angles of the pixels, steradians; 0 where the lens shows nothing."""
    if camera.projection == "equirectangular":
        edges = np.cos(np.linspace(0, np.pi, camera.height + 1))
        return np.repeat((edges[:-1] - edges[1:])[:, None] * 2 * np.pi / camera.width, camera.width, 1)
    if camera.is_pinhole:
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        return (1 + x[None] ** 2 + y[:, None] ** 2) ** -1.5 / (camera.fx * camera.fy)
    directions = pixel_directions(camera)
    across, down = np.gradient(directions, axis=1), np.gradient(directions, axis=0)
    return np.nan_to_num(np.linalg.norm(np.cross(across, down), axis=2))


def typical_focal_length(cameras: Sequence[Camera]) -> float:
    """Return the focal length, pixels, of a pixel that is as large as those of photos are in the mean.

    Away from the middle of a flat picture, pixels see smaller solid angles, and so do small lamps that are smoothed to
    pixels. With the focal length of the middle, lamps at the border would have a fourth more light in an environment
    map than in photos of 54 degrees.
    """

    def of(camera: Camera) -> float:
        if not camera.is_pinhole:  # Pixels are taken as equally large.
            return float(np.sqrt(camera.fx * camera.fy))
        return float(steradians(camera).mean() ** -0.5)

    return float(np.median([of(camera) for camera in cameras]))


def pixels_of_directions(directions: np.ndarray, camera: Camera) -> np.ndarray:
    """Return [..., 2] row and column at which a camera shows directions [..., 3] in its axes; NaN if it does not.

    The center of the first pixel is (0, 0).
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    if camera.projection == "equirectangular":
        column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * camera.width - 0.5
        row = (0.5 - np.arctan2(-y, np.hypot(x, z)) / np.pi) * camera.height - 0.5
        return np.stack([row, column], axis=-1)
    across = np.hypot(x, y)
    theta = np.arctan2(across, z)
    bent = _fisheye_radii(camera.projection, camera.distortion, theta)
    scale = np.where(across > 1e-12, bent / np.maximum(across, 1e-12), np.where(z > 0, 1.0, np.nan))
    column, row = camera.fx * x * scale + camera.cx - 0.5, camera.fy * y * scale + camera.cy - 0.5
    inside = (column >= -0.5) & (column <= camera.width - 0.5) & (row >= -0.5) & (row <= camera.height - 0.5)
    return np.where(inside[..., None], np.stack([row, column], axis=-1), np.nan)


def painted_mask(view: View) -> np.ndarray | None:
    """Return the mask [H, W] in [0, 1] that a photo came with, without the solid angles of a wide camera's pixels.

    None if the photo has none. What the lens does not show is 1.
    """
    if view.mask is None or view.camera.is_pinhole:
        return view.mask
    angles = solid_angles(view.camera)
    mask = np.where(angles > 1e-6, np.clip(view.mask / np.maximum(angles, 1e-6), 0, 1), 1).astype(np.float32)
    return None if mask.min() > 1 - 1e-3 else mask


def perspective_views(views: Sequence[View]) -> tuple[View, ...]:
    """Return pinhole views for what needs them: pinholes as they are, others cut into faces of FACE_ANGLE degrees."""
    return tuple(face for view in views for face in ((view,) if view.camera.is_pinhole else faces_of(view)))


def perspective_cameras(cameras: Iterable[Camera]) -> list[Camera]:
    """Return the cameras of perspective_views(), those of faces with few pixels, without seconds of resampling."""
    pinholes: list[Camera] = []
    for camera in cameras:
        pinholes += [camera] if camera.is_pinhole else [face.camera for face in face_cameras(camera, _COARSE)]
    return pinholes


def faces_of(view: View, size: int | None = None) -> list[View]:
    """Return pinhole views cut from a wide view: forward, right, back, left, up and down, where it shows enough.

    `size` is that of a face in pixels; by default that of the photo's resolution at its axis.
    """
    from scipy.ndimage import map_coordinates

    camera = view.camera
    image, faces = view.image, []
    mask = painted_mask(view)
    for face in face_cameras(camera, size):
        places, visible = face.places, face.visible
        wrap = camera.projection == "equirectangular"
        padded = np.pad(image, ((0, 0), (1, 1), (0, 0)), mode="wrap") if wrap else image
        rows, columns = np.where(visible[..., None], places, 0).transpose(2, 0, 1)
        at = np.stack([rows, columns + wrap])
        codes = np.stack([map_coordinates(padded[..., c], at, order=1, mode="nearest") for c in range(3)], axis=2)
        weights = visible.astype(np.float32)
        if mask is not None:
            weights *= map_coordinates(mask, np.stack([rows, columns]), order=0, mode="nearest")
        part = None if weights.min() >= 1 else weights
        codes = codes_of(codes, 8 if view.codes.dtype == np.uint8 else 16)
        name = f"{view.name}//{face.number}"  # No photo has such a name, as no path has two slashes.
        faces.append(
            replace(view, name=name, codes=codes, camera=face.camera, mask=part, hdr=None, light_above_white=None)
        )
    return faces


class Face(NamedTuple):
    """A pinhole camera that shows a part of a wide one."""

    number: int  # Of its rotation in face_rotations()
    camera: Camera  # The pinhole camera, FACE_ANGLE degrees wide
    places: np.ndarray  # [S, S, 2] rows and columns of the wide picture, the first center (0, 0); NaN outside of it
    visible: np.ndarray  # [S, S] bool, whether the wide picture shows a pixel


def face_cameras(camera: Camera, size: int | None = None) -> list[Face]:
    """Return the faces of a wide camera that it shows enough of; `size` as in faces_of()."""
    count = size or face_size(camera)
    focal = count / 2 / np.tan(np.radians(FACE_ANGLE / 2))
    faces = []
    for number, turn in enumerate(face_rotations()):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, 0
        face = Camera(count, count, focal, focal, count / 2, count / 2, pose @ camera.world_to_camera)
        # A face's axes are turn times the photo's.
        places = np.asarray(pixels_of_directions(pixel_directions(face) @ turn, camera))
        visible = np.asarray(np.isfinite(places).all(axis=2))
        if visible.mean() >= _LEAST_FILLED:
            faces.append(Face(number, face, places, visible))
    return faces


def face_size(camera: Camera) -> int:
    """Return the pixels across a face that has the resolution of a wide camera at its axis."""
    return max(16, round(2 * camera.fx * np.tan(np.radians(FACE_ANGLE / 2))))


def face_rotations() -> np.ndarray:
    """Return [6, 3, 3] rotations from the axes of a photo to those of its faces: front, right, back, left, up, down."""
    turns = []
    for yaw in np.radians([0, 90, 180, 270]):
        c, s = np.cos(yaw), np.sin(yaw)
        turns.append([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    turns += [[[1, 0, 0], [0, 0, 1], [0, -1, 0]], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]]
    return np.rint(np.array(turns))
