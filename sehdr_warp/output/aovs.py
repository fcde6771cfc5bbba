"""AOVs of a view: depth, position, normals, alpha, confidence and clipped share.

Each is a part of its own in the EXR file, tagged as data.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sehdr_warp.errors import SehdrError, did_you_mean
from sehdr_warp.scene import Camera

from .exr import Part, as_data
from .images import as_array

Channels = Mapping[str, np.ndarray]


def _depth(run, rendered, camera: Camera) -> Channels:
    """Return Z along the camera's axis and the distance from the camera; 0 where nothing is."""
    depth = as_array(rendered.depth)
    return {"Z": depth, "distance.Z": depth * np.linalg.norm(_rays(camera), axis=2)}


def _position(run, rendered, camera: Camera) -> Channels:
    points = _points(rendered, camera)
    return {f"position.{axis}": points[..., i] for i, axis in enumerate("XYZ")}


def _normals(run, rendered, camera: Camera) -> Channels:
    """Return surface normals from depth, towards the camera, in world axes; 0 where empty and at borders."""
    points = _points(rendered, camera)
    down, right = (np.gradient(points, axis=axis) if points.shape[axis] > 1 else 0 * points for axis in (0, 1))
    normal = np.cross(down, right)
    normal *= np.where((normal * (camera.position - points)).sum(2, keepdims=True) < 0, -1, 1)
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    # A difference with an empty pixel has no meaning.
    covered = as_array(rendered.depth) > 0
    whole = np.pad(covered, 1)
    whole = whole[1:-1, 1:-1] & whole[:-2, 1:-1] & whole[2:, 1:-1] & whole[1:-1, :-2] & whole[1:-1, 2:]
    normal = np.where(whole[..., None] & (length > 0), normal / np.where(length > 0, length, 1), 0)
    return {f"N.{axis}": normal[..., i] for i, axis in enumerate("XYZ")}


def _alpha(run, rendered, camera: Camera) -> Channels:
    return {"A": as_array(rendered.alpha)}


def _confidence(run, rendered, camera: Camera) -> Channels:
    return {"confidence": _measured(run, run.render_confidence(camera))}


def _clipped(run, rendered, camera: Camera) -> Channels:
    return {"clipped": _measured(run, run.render_clipped(camera))}


def _measured(run, values) -> np.ndarray:
    if values is None:
        raise SehdrError(f"{run.path}: its confidence was not measured; `sehdr-warp report` does, from the photos")
    return as_array(values)


AOVS: Mapping[str, Callable[[Any, Any, Camera], Channels]] = {
    "depth": _depth,
    "position": _position,
    "normals": _normals,
    "alpha": _alpha,
    "confidence": _confidence,
    "clipped": _clipped,
}


def read_aovs(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return names of AOVS from a sequence or a comma-separated list; "all" names all of them.

    Raises:
        SehdrError: For an unknown or repeated name.
    """
    listed = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    if listed == ["all"]:
        return tuple(AOVS)
    for name in listed:
        if name not in AOVS:
            known = ", ".join(AOVS)
            raise SehdrError(f"AOV {name!r} is not one of {known}, all{did_you_mean(name, AOVS)}")
    if len(set(listed)) < len(listed):
        raise SehdrError(f"AOVs {', '.join(listed)}: one is named twice; leave it out")
    return tuple(listed)


def data_parts(names: Sequence[str], run: Any, rendered: Any, camera: Camera, header: Mapping[str, Any]) -> list[Part]:
    """Return the parts of a file that hold AOVs of a rendered view; `header` is that of its picture."""
    return [Part(AOVS[name](run, rendered, camera), as_data(header), name) for name in names]


def _rays(camera: Camera) -> np.ndarray:
    """Return [H, W, 3] rays in camera axes with length 1 along the camera's own axis."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=2)


def _points(rendered, camera: Camera) -> np.ndarray:
    """Return [H, W, 3] world coordinates of the visible surface; 0 where nothing is."""
    depth = as_array(rendered.depth)[..., None]
    points = (_rays(camera) * depth) @ camera.world_to_camera[:3, :3] + camera.position
    return np.where(depth > 0, points, 0)
