"""Cameras to render from, as JSON."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import read_json
from .camera import Camera
from .capture import pose_from_camera_to_world
from .images import MAX_PIXELS
from .names import natural_key
from .read_transforms import frame_lens, frame_pose, frames_of


def load_cameras(path: Path | str) -> list[tuple[str, Camera]]:
    """Named cameras from a JSON file, in its order, without distortion.

    Accepted: {"cameras": [{"name": ..., **Camera.to_dict()}, ...]} (each entry may also keep its values under
    "camera"), nerfstudio's camera_path.json, and transforms.json.
    Raises InputError where the file is damaged, a pose or size cannot be, or two cameras share a name.
    """
    path = Path(path)
    values = read_json(path)
    if isinstance(values.get("cameras"), list):
        cameras = [_own(entry, i, path) for i, entry in enumerate(values["cameras"])]
    elif isinstance(values.get("camera_path"), list):
        cameras = [_nerfstudio(entry, i, values, path) for i, entry in enumerate(values["camera_path"])]
    elif "frames" in values:
        cameras = [
            (Path(name).stem, frame_lens(values, frame, None, path).pinhole(frame_pose(frame, path, name)))
            for name, frame in frames_of(values, path)
        ]
    else:
        raise InputError(path, "has none of cameras, camera_path and frames", "export cameras as the manual describes")
    if not cameras:
        raise InputError(path, "lists no cameras", "add at least one")
    names = [name.lower() for name, _ in cameras]
    if len(set(names)) < len(names):
        twice = min((name for name in names if names.count(name) > 1), key=natural_key)
        raise InputError(path, f"camera name {twice!r} is used twice", "give every camera its own name")
    for i, (name, camera) in enumerate(cameras):
        if not name or any(letter in name for letter in "/\\\0") or name in (".", "..") or len(name) > 200:
            raise InputError(path, f"camera name {name!r:.60} cannot name a file", "use letters, digits, '_' and '-'")
        if camera.width * camera.height > MAX_PIXELS:
            problem = f"camera {i} is {camera.width} x {camera.height}"
            raise InputError(path, problem, f"use sizes of 1 to {MAX_PIXELS} pixels")
    return cameras


@contextmanager
def _usable(index: int, path: Path) -> Iterator[None]:
    try:
        yield
    except KeyError as error:
        raise InputError(path, f"camera {index} has no {error.args[0]}", "add the field") from None
    except (ValueError, TypeError, AttributeError, OverflowError, ZeroDivisionError) as error:
        raise InputError(path, f"camera {index} cannot be used ({str(error)[:120]})", "correct the camera") from None


def _own(entry, index: int, path: Path) -> tuple[str, Camera]:
    with _usable(index, path):
        return str(entry.get("name", f"{index:04d}")), Camera.from_dict(entry.get("camera", entry))


def _nerfstudio(entry, index: int, values: dict, path: Path) -> tuple[str, Camera]:
    """An entry of camera_path.json: camera_to_world (OpenGL axes, 16 numbers by rows) and fov (vertical, degrees)."""
    with _usable(index, path):
        width, height, fov = int(values["render_width"]), int(values["render_height"]), float(entry["fov"])
        matrix = np.array(entry["camera_to_world"], dtype=np.float64).reshape(4, 4)
        if not 1e-6 <= fov < 180:
            raise InputError(path, f"camera {index} has fov {fov}", "use degrees between 0 and 180")
        matrix[:3, 1:3] *= -1
        focal = 0.5 * height / math.tan(math.radians(fov) / 2)
        pose = pose_from_camera_to_world(matrix, path, f"camera {index}")
        return f"{index:04d}", Camera(width, height, focal, focal, width / 2, height / 2, pose)
