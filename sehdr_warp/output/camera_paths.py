"""Camera paths for films: an orbit about what the photos look at, and a smooth way through the photos' places."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from sehdr_warp.errors import SehdrError
from sehdr_warp.scene import Camera

if TYPE_CHECKING:
    from ..runs.run import LoadedScene

Item = TypeVar("Item")

# More than an hour of film at 24 views a second is a slip of the hand.
_LONGEST = 100_000
# A gap in azimuth smaller than this means that the photos go round the scene.
_ROUND_GAP = np.radians(120)
# Mean squared sine between optical axes below which they are parallel in effect: where they meet is then chance, as of
# photos from the air that look down (6 degrees).
_PARALLEL = np.sin(np.radians(6)) ** 2

# Weight of the mean up of the pictures beside the horizon of the cameras. Cameras that all look one way say nothing of
# their pitch by their horizon; then the pictures' mean decides. Where they look around, it moves up by less than 1/10
# of the cameras' mean pitch.
_MEAN_UP_WEIGHT = 0.005
# Middle eigenvalue of the level axes' products, below which cameras look one way: the mean squared sine of 6 degrees.
_ONE_WAY = np.sin(np.radians(6)) ** 2
_CANCELED, _ALIKE = 0.3, 0.7  # Length of the mean up of pictures, and of the mean viewing direction
_DOWN = 0.2  # Mean of the pictures' up along the common up below which the viewing directions decide its sign


def evenly(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most `count` items, evenly chosen from the first to the last."""
    return [items[i] for i in sorted({round(i) for i in np.linspace(0, len(items) - 1, count)})]


def training_cameras(run: "LoadedScene") -> list[Camera]:
    """Return the training cameras of a scene."""
    return [entry.camera for entry in run.cameras if entry.split == "train"]


def common_focus(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the point [3] nearest to all optical axes (least squares); None if they are parallel or it lies behind."""
    positions, forward = _positions(cameras), _axes(cameras, 2)
    off_axis = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    matrix = off_axis.mean(axis=0)
    if np.linalg.eigvalsh(matrix)[0] < _PARALLEL:
        return None
    focus = np.linalg.solve(matrix, (off_axis @ positions[:, :, None]).mean(axis=0)[:, 0])
    return focus if np.median(np.sum((focus - positions) * forward, axis=1)) > 0 else None


def middle_index(cameras: Sequence[Camera]) -> int:
    """Return the index of the camera nearest to the median position."""
    positions = _positions(cameras)
    return int(np.argmin(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))


def orbit(cameras: Sequence[Camera], count: int, focus_distance: float) -> list[Camera]:
    """Return a closed path of cameras around the common focus of a set, upright, all looking at the focus.

    If the set surrounds the focus, the path is a circle of the set's mean radius and height. Otherwise it is an oval
    along the arc that the set covers, as wide as the set scatters about that arc, so that it shows nothing no photo
    shows. Size and intrinsics are those of the middle camera.

    Args:
        cameras: The set, usually the training cameras.
        count: Number of cameras on the path.
        focus_distance: Distance of the focus if the optical axes are parallel; world units, positive.

    Raises:
        SehdrError: Without cameras, or for a count outside 1 to 100 000.
    """
    _check(cameras, count)
    positions, focus = _positions(cameras), common_focus(cameras)
    middle = cameras[int(np.argmin(np.linalg.norm(positions - positions.mean(axis=0), axis=1)))]
    if focus is None:
        focus = middle.position + focus_distance * middle.world_to_camera[2, :3]
    up = up_direction(cameras)
    back = _unit(np.mean(positions, axis=0) - focus, fallback=-middle.world_to_camera[2, :3])
    back = _unit(back - up * (back @ up), fallback=np.linalg.svd(up[None])[2][1])
    right = np.cross(up, back)

    offsets = positions - focus
    horizontal = np.hypot(offsets @ back, offsets @ right)
    azimuths = np.arctan2(offsets @ right, offsets @ back)
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    if _go_round(azimuths):
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
    return [
        _moved(middle, look_at_pose(p, focus, up)) for p in focus + ring[:, None] * directions + height[:, None] * up
    ]


def surround(cameras: Sequence[Camera], focus: np.ndarray) -> bool:
    """Return whether cameras stand all around a point, as seen from above."""
    up = up_direction(cameras)
    east = np.linalg.svd(up[None])[2][1]
    offsets = _positions(cameras) - focus
    return _go_round(np.arctan2(offsets @ np.cross(up, east), offsets @ east))


def _go_round(azimuths: np.ndarray) -> bool:
    ordered = np.sort(azimuths)
    return bool(np.diff(ordered, append=ordered[0] + 2 * np.pi).max() < _ROUND_GAP)


def _along(azimuths: np.ndarray, values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a smooth curve to values over azimuths; return it at other azimuths, and the standard deviation about it.

    People who walk an arc go up and down with the ground; the curve follows that. It never leaves the range of the
    values.
    """
    degree = min(2, (len(values) - 1) // 3) if np.ptp(azimuths) > 1e-6 else 0
    course = np.polynomial.Polynomial.fit(azimuths, values, degree)
    return np.clip(course(at), values.min(), values.max()), float(np.std(values - course(azimuths)))


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the unit vector [3] against gravity that the poses of photos show.

    People hold cameras level: the horizontal axis of a picture, or the vertical one of a picture taken with the camera
    turned by a quarter, is horizontal. Up is the direction nearest to orthogonal to all of them (least squares).
    """
    axes = np.stack([camera.world_to_camera[:3, :3] for camera in cameras])
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
    level = _level_axes(np.stack([camera.world_to_camera[:3, :3] for camera in cameras]), up)
    return float(np.median(np.arcsin(np.clip(np.abs(level @ up), 0, 1))))


def is_pitch_known(cameras: Sequence[Camera], up: np.ndarray) -> bool:
    """Return whether cameras turn enough for their level axes to tell the horizon, not only its direction along one.

    Cameras that all look one way are level along their common axis; how far they are pitched, their poses do not say.
    """
    axes = np.stack([camera.world_to_camera[:3, :3] for camera in cameras])
    level = _level_axes(axes, up)
    looks_down = abs(float(axes[:, 1].mean(axis=0) @ up)) < _DOWN  # From the air: the axes of view tell up.
    return looks_down or bool(np.linalg.eigvalsh(level.T @ level / len(level))[1] > _ONE_WAY)


def _level_axes(axes: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return [n, 3], of the axes [n, 3, 3] of each camera that of the picture which is nearer to the horizon."""
    return np.where((np.abs(axes[:, 0] @ up) <= np.abs(axes[:, 1] @ up))[:, None], axes[:, 0], axes[:, 1])


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
    positions, axes = _positions(cameras), np.stack([camera.camera_to_world[:3, :3] for camera in cameras])
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
    return [_moved(cameras[0], pose) for pose in poses]


def facts_of_cameras(entries: Sequence[Any]) -> dict[str, Any]:
    """Return what a page needs to fly through a scene, as plain values.

    `up` and `focus` are [3] (focus may be None), `size` is the extent of the camera positions, `views` lists name,
    split and camera, and `first` is the index of the view in the middle, which a page opens with.
    """
    cameras = [entry.camera for entry in entries]
    focus, up, size = None, np.array([0.0, -1.0, 0.0]), 0.0
    if cameras:
        focus, size = common_focus(cameras), float(np.linalg.norm(np.ptp(_positions(cameras), axis=0)))
        up = up_direction(cameras)
    return {
        "up": up.tolist(),
        "focus": None if focus is None else focus.tolist(),
        "size": size or 1.0,
        "first": middle_index(cameras) if cameras else 0,
        "views": [
            {"name": e.name, "split": e.split, "time": e.exposure_time, "camera": e.camera.to_dict()} for e in entries
        ],
    }


def _check(cameras: Sequence[Camera], count: int) -> None:
    if not cameras:
        problem = "there are no training views, and a camera path follows theirs"
        remedy = "give a file of cameras, or a file of Gaussians beside its cameras.json (export --cameras)"
        raise SehdrError(f"{problem}; {remedy}")
    if not 1 <= count <= _LONGEST:
        raise SehdrError(f"a camera path of {count} views cannot be; ask for a count of 1 to {_LONGEST}")


def _positions(cameras: Sequence[Camera]) -> np.ndarray:
    return np.stack([camera.position for camera in cameras])


def _axes(cameras: Sequence[Camera], axis: int) -> np.ndarray:
    """[n, 3] the cameras' x, y or z axes in world coordinates."""
    return np.stack([camera.world_to_camera[axis, :3] for camera in cameras])


def _unit(vector: np.ndarray, *, fallback: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else fallback / np.linalg.norm(fallback)


def look_at_pose(position: np.ndarray, focus: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[4, 4] camera to world, OpenCV axes."""
    forward = _unit(focus - position, fallback=np.array([0.0, 0, 1]))
    right = _unit(np.cross(forward, up), fallback=np.linalg.svd(forward[None])[2][1])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, position], axis=1)
    return pose


def _moved(camera: Camera, camera_to_world: np.ndarray) -> Camera:
    return replace(camera, world_to_camera=np.linalg.inv(camera_to_world))
