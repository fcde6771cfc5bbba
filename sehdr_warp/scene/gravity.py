"""The direction against gravity of posed photos: from GPS, from vertical lines in them, or from the poses."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..subsets import every_nth
from .camera import Camera
from .images.ldr_files import PILLOW_ERRORS, exif_of, open_image
from .types import Scene, View

log = logging.getLogger(__name__)

# Weight of the mean up of the pictures beside the horizon of the cameras. Cameras that all look one way say nothing of
# their pitch by their horizon; then the pictures' mean decides. Where they look around, it moves up by less than 1/10
# of the cameras' mean pitch.
_MEAN_UP_WEIGHT = 0.005
# Middle eigenvalue of the level axes' products, below which cameras look one way: the mean squared sine of 6 degrees.
_ONE_WAY = np.sin(np.radians(6)) ** 2
_CANCELED, _ALIKE = 0.3, 0.7  # Length of the mean up of pictures, and of the mean viewing direction
_DOWN = 0.2  # Mean of the pictures' up along the common up below which the viewing directions decide its sign

_LINE_PHOTOS, _LINE_SIZE, _LINE_PIXELS = 24, 320, 1500  # Photos whose edges are read, their size, pixels of each
_STRAIGHT = 0.85  # Coherence of the gradients around a pixel from which it lies on a line
_CONE = 35.0  # Degrees around the up of the poses in which vertical lines are looked for
_LEVEL = 10.0  # Standard deviation, in degrees, of the roll of cameras, by hand or all alike
_LEAST_PEAK = 3.0  # Times that lines agree better on the vertical than on other directions of the cone
# Angles by which lines may raise the typical roll of cameras that turn, and of those that look one way and may be
# rolled alike.
_MORE_ROLL, _MORE_ROLL_ALIKE = math.radians(2.0), math.radians(8.0)

# EXIF's orientations, with the direction in stored pixels (column, row, depth) that is down in the upright picture.
_DOWNWARDS = {3: (0, -1, 0), 4: (0, -1, 0), 5: (1, 0, 0), 6: (1, 0, 0), 7: (-1, 0, 0), 8: (-1, 0, 0)}

_GPS_IFD, _EARTH = 0x8825, 6_371_000.0  # EXIF's table of GPS; mean radius in meters
_GPS_PHOTOS = 4  # Fewest that state a place
_HIGHEST = 1e5  # Meters of an altitude
LEAST_UNIT, MOST_UNIT = 1e-6, 1e6  # Meters of a unit that places may state
_GPS_MISFIT = 0.04  # Largest distance (RMS) between GPS and cameras, of the middle extent of the places


class UpDirection(NamedTuple):
    """A direction against gravity."""

    direction: np.ndarray  # [3] unit vector in world coordinates
    source: str  # "gps", "lines" or "cameras"
    unit: float | None = None  # Meters of a unit of the world, if GPS states it

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return self._asdict() | {"direction": self.direction.tolist()}

    @staticmethod
    def from_dict(values: dict[str, Any] | None) -> "UpDirection | None":
        """Return the direction of plain values; None for None, or if they have no direction."""
        direction = np.array(values["direction"] if values else (0, 0, 0), np.float64)
        length = float(np.linalg.norm(direction))
        return UpDirection(direction / length, values["source"], values.get("unit")) if values and length else None


def find_up(scene: Scene) -> UpDirection:
    """Return the up direction of a scene: by GPS if its places fit, else by vertical lines, else by the poses alone."""
    views = [view for view in scene.train_views if view.camera.is_pinhole] or list(scene.train_views)
    cameras = [upright_camera(view) for view in views]
    by_gps = _up_from_gps(views)
    if by_gps is not None:
        return by_gps
    up = up_direction(cameras)
    by_lines = up_from_lines(views, up) if cameras[0].is_pinhole and not looks_down(cameras, up) else None
    return UpDirection(up, "cameras") if by_lines is None else UpDirection(by_lines, "lines")


def upright_camera(view: View) -> Camera:
    """Return the camera of a view, turned around its axis so that what its photo shows stands upright."""
    down = _DOWNWARDS.get(view.orientation)
    if down is None or not view.camera.is_pinhole:
        return view.camera
    turn = np.eye(4)
    turn[:3, :3] = [np.cross(down, (0, 0, 1)), down, (0, 0, 1)]
    return replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera)


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the unit vector [3] against gravity that the poses of photos show.

    People hold cameras level: the horizontal axis of a picture, or the vertical one of a picture taken with the camera
    turned by a quarter, is horizontal. Up is the direction nearest to orthogonal to all of them (least squares).
    """
    axes = _rotations(cameras)
    mean_up, forward = -axes[:, 1].mean(axis=0), axes[:, 2].mean(axis=0)
    if np.linalg.norm(mean_up) < _CANCELED < _ALIKE < np.linalg.norm(forward):
        # Photos from the air look down with any heading: both axes of all pictures are level.
        level = np.concatenate([axes[:, 0], axes[:, 1]])
        up = np.linalg.eigh(level.T @ level)[1][:, 0]
        return up if up @ forward < 0 else -up
    anchor = mean_up if np.linalg.norm(mean_up) > 1e-6 else -axes[0, 1]
    up = anchor / np.linalg.norm(anchor)
    pull = _MEAN_UP_WEIGHT * np.outer(mean_up, mean_up)
    for _ in range(4):
        level = _level_axes(axes, up)
        spread = (level[:, :, None] * level[:, None, :]).mean(axis=0)
        candidate = np.linalg.eigh(spread - pull)[1][:, 0]
        up = candidate if candidate @ up >= 0 else -candidate
    along = float(mean_up @ up)
    if abs(along) < _DOWN and abs(forward @ up) > _DOWN:  # Photos from the air look down.
        up = -np.sign(forward @ up) * up
    elif along < 0:
        up = -up
    return up


def typical_roll(cameras: Sequence[Camera], up: np.ndarray) -> float:
    """Return the median angle, in radians, between the level axes of pictures and the horizon of an up direction."""
    level = _level_axes(_rotations(cameras), up)
    return float(np.median(np.arcsin(np.clip(np.abs(level @ up), 0, 1))))


def looks_down(cameras: Sequence[Camera], up: np.ndarray) -> bool:
    """Return whether the cameras look straight down, or nearly so: both axes of their pictures are level."""
    return float(np.abs(_rotations(cameras)[:, :2].mean(axis=0) @ up).max()) < _DOWN


def is_pitch_known(cameras: Sequence[Camera], up: np.ndarray) -> bool:
    """Return whether cameras turn enough for their level axes to show the horizon, not only its direction along one.

    Cameras that all look one way are level along their common axis; how far they are pitched, their poses do not say.
    """
    level = _level_axes(_rotations(cameras), up)
    spread = np.linalg.eigvalsh(level.T @ level / len(level))[1]
    return looks_down(cameras, up) or bool(spread > _ONE_WAY)  # From the air the axes of view show up.


def up_from_lines(views: Sequence[View], up: np.ndarray) -> np.ndarray | None:
    """Return the direction [3] on which vertical lines of the photos agree best; None if there are too few.

    A straight edge and the camera's center span a plane, which holds the vertical if the edge is vertical (edges of
    walls, windows, doors). The direction with most planes within a degree is taken, weighted by how level it leaves the
    cameras. It is None if other directions fit nearly as many, or if the cameras are less level then.

    Args:
        views: Photos of pinhole cameras.
        up: Direction nearby, from up_direction.
    """
    sample = every_nth(views, _LINE_PHOTOS)
    parts = [_edge_planes(view) for view in sample]
    normals, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
    near = np.abs(normals @ up) < math.sin(math.radians(_CONE))
    normals, weights = normals[near], weights[near] / len(sample)
    cameras = [upright_camera(view) for view in views]
    level = _level_axes(_rotations(cameras), up)

    def search(center: np.ndarray, radius: float, step: float, width: float, skip: int = 1) -> tuple[np.ndarray, float]:
        directions = _directions_around(center, radius, step)
        rolls = np.degrees(np.arcsin(np.clip(level @ directions.T, -1, 1)))
        support = _support(normals[::skip], weights[::skip], directions, width)
        index = int(np.argmax(support * np.exp(-0.5 * (rolls / _LEVEL) ** 2).mean(axis=0)))
        return directions[index], float(support[index])

    best, _ = search(up, _CONE, 1.5, 1.0, 4)
    best, _ = search(best, 3.0, 0.5, 1.0)
    best, peak = search(best, 0.8, 0.1, 0.7)
    usual = float(np.median(_support(normals, weights, _directions_around(up, _CONE, 3.0), 0.7)))
    if peak < _LEAST_PEAK * usual or peak <= 0:
        return None
    most = typical_roll(cameras, up) + (_MORE_ROLL if is_pitch_known(cameras, up) else _MORE_ROLL_ALIKE)
    return None if typical_roll(cameras, best) > most else best


def _edge_planes(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals [N, 3], in world coordinates, of planes through edges of a photo, and weights [N]."""
    from scipy.ndimage import gaussian_filter, gaussian_filter1d

    height, width = view.codes.shape[:2]
    step = max(1, round(max(height, width) / _LINE_SIZE))
    rows, columns = height // step, width // step
    grey = np.asarray(view.codes[: rows * step, : columns * step], np.float32).mean(axis=2)
    grey = grey.reshape(rows, step, columns, step).mean(axis=(1, 3)) / view.levels
    grey = np.log(grey + 0.02)  # Edges in shadow count as those in light.
    down = gaussian_filter1d(gaussian_filter1d(grey, 1.0, axis=1), 1.0, axis=0, order=1)
    right = gaussian_filter1d(gaussian_filter1d(grey, 1.0, axis=0), 1.0, axis=1, order=1)
    xx, yy, xy = (gaussian_filter(product, 2.0) for product in (right * right, down * down, right * down))
    anisotropy = np.hypot(xx - yy, 2 * xy)
    strength = anisotropy * (anisotropy > _STRAIGHT * (xx + yy))
    inside = np.zeros_like(strength, bool)
    inside[4:-4, 4:-4] = True
    strength = np.where(inside, strength, 0).ravel()
    pixels = np.argsort(-strength, kind="stable")[:_LINE_PIXELS]
    pixels = pixels[strength[pixels] > 1e-9]
    angle = 0.5 * np.arctan2(2 * xy, xx - yy).ravel()[pixels]
    row, column = np.unravel_index(pixels, (rows, columns))
    x, y = (column + 0.5) * step, (row + 0.5) * step
    lines = np.stack([np.cos(angle), np.sin(angle), -(np.cos(angle) * x + np.sin(angle) * y)], axis=1)
    camera = view.camera
    planes = lines @ np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    planes = planes / np.linalg.norm(planes, axis=1, keepdims=True) @ camera.world_to_camera[:3, :3]
    weights = np.sqrt(strength[pixels])
    return planes, weights / max(float(weights.sum()), 1e-12)


def _directions_around(center: np.ndarray, radius: float, step: float) -> np.ndarray:
    """Return unit vectors [N, 3] on a grid of `step` degrees within `radius` degrees of one."""
    offsets = np.arange(-radius, radius + 1e-6, step)
    first, second = (grid.ravel() for grid in np.meshgrid(offsets, offsets))
    inside = np.hypot(first, second) <= radius
    across = np.linalg.svd(center[None])[2][1:]
    tangents = np.tan(np.radians(np.stack([first[inside], second[inside]], axis=1)))
    directions = center + tangents @ across
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _support(normals: np.ndarray, weights: np.ndarray, directions: np.ndarray, width: float) -> np.ndarray:
    """Return [N], the weight of planes that hold each direction, to about `width` degrees."""
    support = np.zeros(len(directions))
    for start in range(0, len(normals), 4096):
        part = slice(start, start + 4096)
        off = normals[part] @ directions.T / math.radians(width)
        support += np.exp(-0.5 * off**2).T @ weights[part]
    return support


def _up_from_gps(views: Sequence[View]) -> UpDirection | None:
    """Return up and the unit of length by the places in the photos' EXIF; None if they do not fit the cameras."""
    gps_places = [(place, view.camera.position) for view in views if (place := _gps_place(view.source)) is not None]
    if len(gps_places) < max(_GPS_PHOTOS, len(views) // 2):
        return None
    places, cameras = (np.array(each) for each in zip(*gps_places, strict=True))
    places[:, 1] = np.unwrap(places[:, 1], period=360)  # Across the 180th meridian
    middle = places.mean(axis=0)
    east = np.radians(places[:, 1] - middle[1]) * math.cos(math.radians(middle[0])) * _EARTH
    local = np.stack([east, np.radians(places[:, 0] - middle[0]) * _EARTH, places[:, 2] - middle[2]], axis=1)
    offsets = cameras - cameras.mean(axis=0)
    extent = np.linalg.svd(local, compute_uv=False) / math.sqrt(len(local))
    if extent[1] < 1e-6 or not offsets.any():
        return None
    # Umeyama's similarity from the cameras to east, north and up
    left, values, right = np.linalg.svd(local.T @ offsets)
    sign = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    rotation = (left * sign) @ right
    squared = float((offsets**2).sum())
    unit = float((values * sign).sum()) / squared if squared > 0 else 0.0
    if not LEAST_UNIT <= unit <= MOST_UNIT:
        return None
    misfit = math.sqrt(float(((unit * offsets @ rotation.T - local) ** 2).sum(axis=1).mean()))
    return UpDirection(rotation[2], "gps", unit) if misfit < _GPS_MISFIT * extent[1] else None


def _gps_place(path: Path | None) -> tuple[float, float, float] | None:
    """Return latitude and longitude in degrees and altitude in meters that a photo states; None without all three."""
    if path is None or not path.is_file():
        return None
    try:
        with open_image(path) as image:
            table = exif_of(image).get_ifd(_GPS_IFD)
        latitude = _degrees(table[2], table[1] in ("S", b"S"))
        longitude = _degrees(table[4], table[3] in ("W", b"W"))
        altitude = float(table[6]) * (-1 if table.get(5) in (1, b"\x01") else 1)
    except (*PILLOW_ERRORS, InputError, KeyError, TypeError, ValueError, ArithmeticError):
        return None
    place = (latitude, longitude, altitude)
    fits = abs(altitude) <= _HIGHEST and abs(latitude) <= 90 and abs(longitude) <= 180 and place[:2] != (0, 0)
    return place if fits else None


def _degrees(values: Any, negative: bool) -> float:
    degrees, minutes, seconds = (float(value) for value in values)
    return (degrees + minutes / 60 + seconds / 3600) * (-1 if negative else 1)


def _rotations(cameras: Sequence[Camera]) -> np.ndarray:
    """Return [n, 3, 3] from the world to each camera."""
    return np.stack([camera.world_to_camera[:3, :3] for camera in cameras])


def _level_axes(axes: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return [n, 3], of the axes [n, 3, 3] of each camera that of the picture which is nearer to the horizon."""
    return np.where((np.abs(axes[:, 0] @ up) <= np.abs(axes[:, 1] @ up))[:, None], axes[:, 0], axes[:, 1])
