"""Render one view of a scene as arrays on the CPU: light, coverage, depth, confidence, and the AOVs made of them.

Each AOV is a part of its own in the EXR file, tagged as data.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SehdrError, did_you_mean
from ..scene import Camera
from ..scene.wide_camera import pixel_rays, surface_points
from .images.exr import Part, as_data
from .world_transform import WorldTransform

if TYPE_CHECKING:
    from ..runs.run import RenderableScene


@dataclass(frozen=True)
class ViewImages:
    """A rendered view on the CPU."""

    camera: Camera  # In the coordinates of the file
    hdr: np.ndarray  # [H, W, 3] linear Rec.709 radiance
    alpha: np.ndarray  # [H, W] coverage
    depth: np.ndarray  # [H, W] file units along the axis, of a wide camera the distance; 0 where nothing is
    confidence: np.ndarray | None  # [H, W] in [0, 1]; None if it was not measured
    clipped: np.ndarray | None  # [H, W] share of the light that photos clip; None if no AOV asks for it


def render_images(
    run: "RenderableScene", camera: Camera, transform: WorldTransform, aovs: Sequence[str] = ()
) -> ViewImages:
    """Render a view from a camera in the scene's coordinates; `transform` leads to those of the file.

    Raises SehdrError if one of the AOVs was not measured for the run.
    """
    rendered = run.render(camera, data=("confidence", "clipped") if "clipped" in aovs else ("confidence",))
    confidence, clipped = rendered.confidence, rendered.clipped
    for name, values in (("confidence", confidence), ("clipped", clipped)):
        if values is None and name in aovs:
            remedy = "`sehdr-warp report` measures it for a run, from the photos; else leave the AOV out"
            raise SehdrError(f"{run.path}: AOV {name} was not measured; {remedy}")
    return ViewImages(
        transform.camera(camera),
        rendered.hdr.cpu().numpy(),
        rendered.alpha.cpu().numpy(),
        rendered.depth.cpu().numpy() * np.float32(transform.scale),
        confidence=None if confidence is None else confidence.cpu().numpy(),
        clipped=None if clipped is None else clipped.cpu().numpy(),
    )


Channels = Mapping[str, Any]


def _depth(images: ViewImages) -> Channels:
    """Return Z and the distance from the camera; 0 where nothing is."""
    depth = images.depth
    return {"Z": depth, "distance.Z": depth * np.linalg.norm(pixel_rays(images.camera), axis=2)}


def _position(images: ViewImages) -> Channels:
    points = _points(images)
    return {f"position.{axis}": points[..., i] for i, axis in enumerate("XYZ")}


def _normals(images: ViewImages) -> Channels:
    """Return surface normals from depth, towards the camera, in the file's axes; 0 where empty and at borders."""
    points = _points(images)
    down, right = (np.gradient(points, axis=axis) if points.shape[axis] > 1 else 0 * points for axis in (0, 1))
    normal = np.cross(down, right)
    normal *= np.where((normal * (images.camera.position - points)).sum(2, keepdims=True) < 0, -1, 1)
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    # A difference with an empty pixel has no meaning.
    covered = images.depth > 0
    whole = np.pad(covered, 1)
    whole = whole[1:-1, 1:-1] & whole[:-2, 1:-1] & whole[2:, 1:-1] & whole[1:-1, :-2] & whole[1:-1, 2:]
    normal = np.where(whole[..., None] & (length > 0), normal / np.where(length > 0, length, 1), 0)
    return {f"N.{axis}": normal[..., i] for i, axis in enumerate("XYZ")}


AOVS: Mapping[str, Callable[[ViewImages], Channels]] = {
    "depth": _depth,
    "position": _position,
    "normals": _normals,
    "alpha": lambda images: {"A": images.alpha},
    "confidence": lambda images: {"confidence": images.confidence},
    "clipped": lambda images: {"clipped": images.clipped},
}


def read_aovs(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return names of AOVS from a sequence or a comma-separated list; "all" names all of them.

    Raises:
        SehdrError: For an unknown or repeated name.
    """
    if not isinstance(names, str | Sequence):
        raise TypeError(f"aovs is {names!r:.60}, expected a list of names, or text with commas")
    requested = [name.strip() for name in names.split(",") if names] if isinstance(names, str) else list(names)
    for name in requested:
        if name not in AOVS and name != "all":
            raise SehdrError(f"AOV {name!r} is not one of {', '.join(AOVS)}, all{did_you_mean(name, AOVS)}")
    if "all" in requested:
        return tuple(AOVS)
    if len(set(requested)) < len(requested):
        raise SehdrError(f"AOVs {', '.join(requested)}: one is named twice; leave it out")
    return tuple(requested)


def data_parts(names: Sequence[str], images: ViewImages, attributes: Mapping[str, Any]) -> list[Part]:
    """Return the parts of a file that hold AOVs of a rendered view; `attributes` are those of its picture."""
    return [Part(AOVS[name](images), as_data(attributes), name) for name in names]


def _points(images: ViewImages) -> np.ndarray:
    """Return [H, W, 3] coordinates of the visible surface in the file; 0 where nothing is."""
    return np.where(images.depth[..., None] > 0, surface_points(images.camera, images.depth), 0)
