"""AOVs of a view: depth, position, normals, alpha, confidence and clipped share.

Each is a part of its own in the EXR file, tagged as data.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SehdrError, did_you_mean
from ..scene import Camera
from ..scene.wide_camera import pixel_directions
from .exr import Part, as_data
from .images import as_array

if TYPE_CHECKING:
    from ..runs.run import RenderableScene


@dataclass(frozen=True)
class ViewData:
    """A rendered view.

    Attributes:
        run: Scene that it shows.
        camera: In the scene's coordinates.
        camera_in_file: The same camera in the coordinates of the file.
        alpha: [H, W] coverage.
        depth: [H, W] in the file's units, along the camera's axis; 0 where nothing is.
    """

    run: "RenderableScene"
    camera: Camera
    camera_in_file: Camera
    alpha: np.ndarray
    depth: np.ndarray


Channels = Mapping[str, np.ndarray]


def _depth(view: ViewData) -> Channels:
    """Return Z along the camera's axis and the distance from the camera; 0 where nothing is."""
    depth = view.depth
    return {"Z": depth, "distance.Z": depth * np.linalg.norm(_rays(view.camera_in_file), axis=2)}


def _position(view: ViewData) -> Channels:
    points = _points(view)
    return {f"position.{axis}": points[..., i] for i, axis in enumerate("XYZ")}


def _normals(view: ViewData) -> Channels:
    """Return surface normals from depth, towards the camera, in world axes; 0 where empty and at borders."""
    points = _points(view)
    down, right = (np.gradient(points, axis=axis) if points.shape[axis] > 1 else 0 * points for axis in (0, 1))
    normal = np.cross(down, right)
    normal *= np.where((normal * (view.camera_in_file.position - points)).sum(2, keepdims=True) < 0, -1, 1)
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    # A difference with an empty pixel has no meaning.
    covered = view.depth > 0
    whole = np.pad(covered, 1)
    whole = whole[1:-1, 1:-1] & whole[:-2, 1:-1] & whole[2:, 1:-1] & whole[1:-1, :-2] & whole[1:-1, 2:]
    normal = np.where(whole[..., None] & (length > 0), normal / np.where(length > 0, length, 1), 0)
    return {f"N.{axis}": normal[..., i] for i, axis in enumerate("XYZ")}


def _alpha(view: ViewData) -> Channels:
    return {"A": view.alpha}


def _confidence(view: ViewData) -> Channels:
    return {"confidence": _require_values(view.run, view.run.render_confidence(view.camera))}


def _clipped_part(view: ViewData) -> Channels:
    return {"clipped": _require_values(view.run, view.run.render_clipped(view.camera))}


def _require_values(run: "RenderableScene", values) -> np.ndarray:
    if values is None:
        raise SehdrError(f"{run.path}: its confidence was not measured; `sehdr-warp report` does, from the photos")
    return as_array(values)


AOVS: Mapping[str, Callable[[ViewData], Channels]] = {
    "depth": _depth,
    "position": _position,
    "normals": _normals,
    "alpha": _alpha,
    "confidence": _confidence,
    "clipped": _clipped_part,
}


def read_aovs(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return names of AOVS from a sequence or a comma-separated list; "all" names all of them.

    Raises:
        SehdrError: For an unknown or repeated name.
    """
    requested = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    for name in requested:
        if name not in AOVS and name != "all":
            names_text = ", ".join(AOVS)
            raise SehdrError(f"AOV {name!r} is not one of {names_text}, all{did_you_mean(name, AOVS)}")
    if "all" in requested:
        return tuple(AOVS)
    if len(set(requested)) < len(requested):
        raise SehdrError(f"AOVs {', '.join(requested)}: one is named twice; leave it out")
    return tuple(requested)


def data_parts(names: Sequence[str], view: ViewData, header: Mapping[str, Any]) -> list[Part]:
    """Return the parts of a file that hold AOVs of a rendered view; `header` is that of its picture."""
    return [Part(AOVS[name](view), as_data(header), name) for name in names]


def _rays(camera: Camera) -> np.ndarray:
    """Return [H, W, 3] rays in camera axes, 1 long along the camera's own axis; unit vectors for a wide camera."""
    if not camera.is_pinhole:
        return np.nan_to_num(pixel_directions(camera))
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=2)


def _points(view: ViewData) -> np.ndarray:
    """Return [H, W, 3] world coordinates of the visible surface; 0 where nothing is."""
    camera, depth = view.camera_in_file, view.depth[..., None]
    points = (_rays(camera) * depth) @ camera.world_to_camera[:3, :3] + camera.position
    return np.where(depth > 0, points, 0)
