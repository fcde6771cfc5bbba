"""Camera paths: around what the photos look at, along a walk, or a smooth way through the photos' places."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...errors import SehdrError, require_whole_number
from ...scene import Camera
from ...scene.camera_focus import camera_axes, camera_positions, common_focus
from ...scene.gravity import looks_down, up_direction
from .scene_cameras import is_full_circle

_LONGEST = 100_000  # More than an hour of film at 24 views a second is a slip of the hand
# Cosine between the step from a photo to the next and their optical axes. A walk ahead has a median near 1, walks
# around something, along it and flights 0 to 0.3.
_AHEAD, _ASIDE = 0.7, 0.3
_LEAP = 5.0  # Steps this many times as long as the median are breaks of a walk: cameras that were placed wrongly.
_SMOOTH, _SMOOTH_UP = 1.2, 4.0  # Standard deviations, in photos, of what evens places and axes of a walk, and its up


def orbit(cameras: Sequence[Camera], count: int, focus_distance: float, up: np.ndarray | None = None) -> list[Camera]:
    """Return a closed path of cameras around the common focus of a set, upright, all looking at the focus.

    If the set surrounds the focus, the path is a circle of the set's mean radius and height. Otherwise it is an oval
    along the arc that the set covers, as wide as the set scatters about that arc, so that it shows nothing no photo
    shows. Size and intrinsics are those of the middle camera.

    Args:
        cameras: The set, usually the training cameras.
        count: Number of cameras on the path.
        focus_distance: Distance of the focus if the optical axes are parallel; world units, positive.
        up: [3] unit vector; None takes that of the poses.

    Raises:
        SehdrError: Without cameras, or for a count outside 1 to 100 000.
    """
    _check(cameras, count)
    positions, focus = camera_positions(cameras), common_focus(cameras)
    middle = cameras[int(np.argmin(np.linalg.norm(positions - positions.mean(axis=0), axis=1)))]
    if focus is None:
        focus = middle.position + focus_distance * middle.world_to_camera[2, :3]
    up = up_direction(cameras) if up is None else up
    back = _unit(np.mean(positions, axis=0) - focus, fallback=-middle.world_to_camera[2, :3])
    back = _unit(back - up * (back @ up), fallback=np.linalg.svd(up[None])[2][1])
    right = np.cross(up, back)

    offsets = positions - focus
    horizontal = np.hypot(offsets @ back, offsets @ right)
    azimuths = np.arctan2(offsets @ right, offsets @ back)
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    if is_full_circle(azimuths):
        azimuth = turn
        ring, height = np.full(count, horizontal.mean()), np.full(count, (offsets @ up).mean())
    else:
        # An ellipse whose points have the photos' spread: a cosine's variance is a half.
        azimuth = azimuths.mean() + np.sqrt(2) * azimuths.std() * np.sin(turn)
        elevation, scatter = _along(azimuths, np.arctan2(offsets @ up, horizontal), azimuth)
        elevation = elevation + np.sqrt(2) * scatter * np.cos(turn)
        distance = _along(azimuths, np.linalg.norm(offsets, axis=1), azimuth)[0]
        ring, height = distance * np.cos(elevation), distance * np.sin(elevation)
    directions = np.cos(azimuth)[:, None] * back + np.sin(azimuth)[:, None] * right
    # From the air the pictures keep their heading: they would spin with the azimuth.
    above = -middle.world_to_camera[1, :3] if looks_down(cameras, up) else up
    places = focus + ring[:, None] * directions + height[:, None] * up
    return [moved(middle, look_at_pose(place, focus, above)) for place in places]


def walk(cameras: Sequence[Camera]) -> list[Camera]:
    """Return the longest unbroken part of a set that was photographed while walking ahead; else an empty list.

    Args:
        cameras: In the order of the photos.
    """
    if len(cameras) < 4:
        return []
    positions, forward = camera_positions(cameras), camera_axes(cameras, 2)
    steps, axes = np.diff(positions, axis=0), forward[1:] + forward[:-1]
    lengths = np.linalg.norm(steps, axis=1)
    ahead = np.sum(steps * axes, axis=1) / np.maximum(lengths * np.linalg.norm(axes, axis=1), 1e-12)
    if np.median(ahead) < _AHEAD:
        return []
    breaks = np.flatnonzero((lengths > _LEAP * np.median(lengths)) | (ahead < _ASIDE)) + 1
    parts = np.split(np.arange(len(cameras)), breaks)
    longest = max(parts, key=lambda part: (len(part), lengths[part[:-1]].sum()))
    return [cameras[index] for index in longest] if len(longest) >= 4 else []


def walk_path(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """Return `count` cameras along a walk, evenly spaced, with the sway of hands taken out.

    Their up is that of the photos around them: structure from motion bends long walks, so that none is up everywhere.
    Raises SehdrError without cameras, or for a count outside 1 to 100 000.
    """
    from scipy.ndimage import gaussian_filter1d

    _check(cameras, count)
    positions = camera_positions(cameras)
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    samples = 16 * len(cameras)
    at, fine = np.linspace(0, lengths[-1], count), np.linspace(0, lengths[-1], samples)

    def smooth(values: np.ndarray, deviation: float) -> np.ndarray:
        sampled = np.stack([np.interp(fine, lengths, column) for column in values.T], axis=1)
        sampled = gaussian_filter1d(sampled, deviation * 16, axis=0, mode="nearest")
        return np.stack([np.interp(at, fine, column) for column in sampled.T], axis=1)

    places, forward = smooth(positions, _SMOOTH), smooth(camera_axes(cameras, 2), _SMOOTH)
    up = smooth(-camera_axes(cameras, 1), _SMOOTH_UP)
    rows = zip(places, forward, up, strict=True)
    return [moved(cameras[0], look_at_pose(place, place + ahead, above)) for place, ahead, above in rows]


def _along(azimuths: np.ndarray, values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a smooth curve to values over azimuths; return it at other azimuths, and the standard deviation about it.

    People who walk an arc go up and down with the ground; the curve follows that. It never leaves the range of the
    values.
    """
    degree = min(2, (len(values) - 1) // 3) if np.ptp(azimuths) > 1e-6 else 0
    course = np.polynomial.Polynomial.fit(azimuths, values, degree)
    return np.clip(course(at), values.min(), values.max()), float(np.std(values - course(azimuths)))


def interpolate(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """Return `count` cameras along a smooth path through a set, in its order, evenly spaced in time.

    Positions follow a cubic spline and rotations a spherical one (scipy's RotationSpline), both over chord length, so
    that speed stays even. Size and intrinsics are those of the first camera.

    Raises:
        SehdrError: Without cameras, or for a count outside 1 to 100 000.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    _check(cameras, count)
    positions, axes = camera_positions(cameras), np.stack([camera.camera_to_world[:3, :3] for camera in cameras])
    rotations = Rotation.from_matrix(axes)
    size = max(float(np.ptp(positions, axis=0).max()), 1e-9)
    moves = np.linalg.norm(np.diff(positions, axis=0), axis=1) / size
    steps = np.append(0.0, moves + (rotations[:-1].inv() * rotations[1:]).magnitude()) if len(cameras) > 1 else [0.0]
    keep = np.append(True, np.array(steps[1:]) > 1e-6)
    times = np.cumsum(steps)[keep]
    if len(times) == 1:
        return [cameras[0]] * count
    at = np.linspace(0, times[-1], count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = RotationSpline(times, Rotation.from_matrix(axes[keep]))(at).as_matrix()
    poses[:, :3, 3] = CubicSpline(times, positions[keep])(at)
    return [moved(cameras[0], pose) for pose in poses]


def _check(cameras: Sequence[Camera], count: int) -> None:
    if not cameras:
        raise SehdrError("there are no training views, and a camera path follows theirs; give a file of cameras")
    require_whole_number(count, "count")
    if not 1 <= count <= _LONGEST:
        raise SehdrError(f"a camera path cannot have {count} views; ask for a count of 1 to {_LONGEST}")


def _unit(vector: np.ndarray, *, fallback: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else fallback / np.linalg.norm(fallback)


def look_at_pose(position: np.ndarray, focus: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the pose [4, 4] of a camera that looks at a focus: camera to world, OpenCV axes."""
    forward = _unit(focus - position, fallback=np.array([0.0, 0, 1]))
    right = _unit(np.cross(forward, up), fallback=np.linalg.svd(forward[None])[2][1])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, position], axis=1)
    return pose


def moved(camera: Camera, camera_to_world: np.ndarray) -> Camera:
    """Return a camera with another pose [4, 4]."""
    return replace(camera, world_to_camera=np.linalg.inv(camera_to_world))
