"""Readers of camera files: JSON of this package, nerfstudio and 3DGS, transforms.json, COLMAP models, OpenUSD."""

import json
import logging
import math
from collections import Counter
from pathlib import Path

import numpy as np

from ...errors import InputError, path_of
from ...files import read_json, read_text
from ...json_values import damage, description_of, number, numbers, text, whole_number
from ..camera import Camera
from ..dataparser import pose_from_camera_to_world
from ..file_names import natural_key
from ..images.ldr_files import MAX_PIXELS
from .camera_exchange import EXCHANGE_SUFFIXES, ExchangeCameras, read_exchange_cameras
from .colmap_model import find_model, read_model
from .transforms import frame_pose, frames_of, pose_from_opengl
from .transforms_lens import frame_lens

log = logging.getLogger(__name__)
_DATAPARSER = "dataparser_transforms.json"
_SPLATS = (".ply", ".splat", ".spz", ".ksplat", ".sog")
_UNREAD = {".abc": "Alembic", ".fbx": "FBX", ".nk": "Nuke script", ".blend": "Blender"}
"""Files with cameras that no well-kept library for Python reads."""


def load_cameras(path: Path | str) -> list[tuple[str, Camera]]:
    """Read named cameras from a file, in its order, without distortion.

    Args:
        path: {"cameras": [{"name": ..., **Camera.to_dict()}, ...]}, nerfstudio's camera_path.json, transforms.json, the
            cameras.json of 3DGS's reference release, a COLMAP model's folder, or an OpenUSD stage, whose moving cameras
            give one camera for each frame. nerfstudio's paths are in the coordinates of its dataparser; a
            dataparser_transforms.json beside the file, which it writes with a training, converts them to the set's own.

    Raises:
        InputError: if the file is damaged, a pose or size is not possible, or two cameras share a name.
    """
    return read_camera_file(path_of(path, "path")).cameras


def read_camera_file(path: Path) -> ExchangeCameras:
    """Read cameras as load_cameras does, with the transform from the photos' coordinates if the file states it."""
    if path.suffix.lower() in _UNREAD:
        problem = f"{_UNREAD[path.suffix.lower()]} files are not read"
        raise InputError(path, problem, "export the camera as OpenUSD (.usda or .usdc), or from Nuke as .chan")
    if path.suffix.lower() in _SPLATS and path.is_file():
        raise InputError(
            path, "holds Gaussians or points, not cameras", "give a camera file or a COLMAP model's folder"
        )
    if path.is_dir():
        file = ExchangeCameras(_of_colmap(path))
    elif path.suffix.lower() in EXCHANGE_SUFFIXES:
        file = read_exchange_cameras(path)
        if not file.up_stated:
            log.warning("%s: states no upAxis; +Y counts as up, as in USD", path)
    else:
        file = ExchangeCameras(_of_json(path))
    cameras = file.cameras
    if not cameras:
        raise InputError(path, "lists no cameras", "add at least one")
    names = Counter(name.lower() for name, _ in cameras)
    if len(names) < len(cameras):
        twice = min((name for name, count in names.items() if count > 1), key=natural_key)
        raise InputError(path, f"camera name {twice!r} is used twice", "give every camera its own name")
    for i, (name, camera) in enumerate(cameras):
        if not name or any(letter in name for letter in "/\\\0") or name in (".", "..") or len(name) > 200:
            raise InputError(path, f"camera name {name!r:.60} cannot name a file", "use letters, digits, '_' and '-'")
        if camera.pixel_count > MAX_PIXELS:
            size = f"{camera.width} x {camera.height}"
            raise InputError(path, f"camera {i} is {size}", f"use sizes of 1 to {MAX_PIXELS} pixels")
    return file


def _of_json(path: Path) -> list[tuple[str, Camera]]:
    if (content := read_text(path)).lstrip().startswith("["):
        try:
            entries = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise InputError(path, f"is not valid JSON ({error})", "export the file again") from None
        return _cameras(path, entries, lambda entry, _: (text(entry, "img_name"), _inria(entry, path)))
    values = read_json(path)
    if isinstance(values.get("cameras"), list):
        return _cameras(path, values["cameras"], lambda e, i: (text(e, "name", f"{i:04d}"), Camera.from_dict(e)))
    if isinstance(values.get("camera_path"), list):
        back = _dataparser(path)
        return _cameras(path, values["camera_path"], lambda e, i: (f"{i:04d}", _nerfstudio(e, i, values, path, back)))
    if "frames" in values:
        return [
            (Path(name).stem, frame_lens(values, frame, None, path).camera(frame_pose(frame, path, name)))
            for name, frame in frames_of(values, path)
        ]
    raise InputError(path, "has none of cameras, camera_path and frames", "export cameras as the manual describes")


def _cameras(path: Path, entries: list, read) -> list[tuple[str, Camera]]:
    """Call read(entry, index) for each entry, with errors that name the camera."""
    cameras = []
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            problem = f"camera {i} is {description_of(entry)}, not an object"
            raise InputError(path, problem, "state its size, focal lengths and pose by name, or give another file")
        try:
            cameras.append(read(entry, i))
        except KeyError as error:
            raise InputError(path, f"camera {i} has no {error.args[0]}", "add the field") from None
        except (ValueError, OverflowError, ZeroDivisionError) as error:
            raise InputError(path, f"camera {i} cannot be used ({error!s:.120})", "correct the camera") from None
    return cameras


def _inria(entry: dict, path: Path) -> Camera:
    """Read position and rotation (rows) of camera to world in OpenCV axes, fx and fy in pixels.

    The reference release states no cx and cy, as its axes are centered; export writes those that are not.
    """
    width, height = (whole_number(entry, name) for name in ("width", "height"))
    matrix = np.c_[numbers(entry, "rotation", 3, 3), numbers(entry, "position", 3)]
    pose = pose_from_camera_to_world(matrix, path, text(entry, "img_name"))
    cx, cy = number(entry, "cx", width / 2), number(entry, "cy", height / 2)
    return Camera(width, height, number(entry, "fx"), number(entry, "fy"), cx, cy, pose)


def _nerfstudio(entry, index: int, values: dict, path: Path, back: np.ndarray | None) -> Camera:
    """Read an entry of camera_path.json: camera_to_world (OpenGL axes, 16 numbers by rows), fov (vertical, degrees)."""
    width, height = (whole_number(values, name) for name in ("render_width", "render_height"))
    kind = entry.get("camera_type", values.get("camera_type", "perspective"))
    if kind != "perspective":
        raise InputError(path, f"camera {index} has camera_type {kind!r:.40}", "use perspective cameras")
    fov, matrix = number(entry, "fov"), numbers(entry, "camera_to_world", 4, 4)
    if not 1e-6 <= fov < 180:
        raise InputError(path, f"camera {index} has fov {fov}", "use degrees between 0 and 180")
    if back is not None:
        with np.errstate(all="ignore"):  # What is not finite is refused below.
            matrix = back @ matrix
            matrix[:3, :3] /= np.cbrt(np.linalg.det(matrix[:3, :3]))
    focal = 0.5 * height / math.tan(math.radians(fov) / 2)
    pose = pose_from_opengl(matrix, path, f"camera {index}")
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def _dataparser(path: Path) -> np.ndarray | None:
    """Return the matrix [4, 4] from nerfstudio's coordinates to the set's, None without its file beside the path."""
    beside = path.with_name(_DATAPARSER)
    if not beside.is_file():
        log.warning("%s: no %s next to it; its cameras are used unchanged", path, _DATAPARSER)
        return None
    values = read_json(beside)
    try:
        matrix, scale = numbers(values, "transform", 3, 4), number(values, "scale")
        return np.linalg.inv(np.diag([scale, scale, scale, 1.0]) @ np.r_[matrix, [[0, 0, 0, 1]]])
    except (KeyError, ValueError, np.linalg.LinAlgError) as error:
        problem = f"has no usable transform and scale ({damage(error)})"
        raise InputError(beside, problem, "copy nerfstudio's file of the training") from None


def _of_colmap(folder: Path) -> list[tuple[str, Camera]]:
    source = find_model(folder)
    if source is None:
        raise InputError(folder, "holds no COLMAP model", "give the folder of a COLMAP model, or a camera file")
    model = read_model(source, points=False)
    if model.unusable:
        raise model.unusable[0]
    images = sorted(model.images, key=lambda image: natural_key(image.name))
    return [(Path(image.name).stem, image.lens.camera(image.world_to_camera)) for image in images]
