"""Render one view of a scene as arrays on the CPU, in the units and coordinates of files."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..scene import Camera
from .images.ldr_files import as_array
from .world_transform import WorldTransform

if TYPE_CHECKING:
    from ..runs.run import RenderableScene


@dataclass(frozen=True)
class ViewImages:
    """A rendered view on the CPU.

    Attributes:
        run: Scene that it shows.
        camera: In the scene's coordinates.
        camera_in_file: The same camera in the coordinates of the file.
        hdr: [H, W, 3] linear Rec.709 radiance.
        alpha: [H, W] coverage.
        depth: [H, W] in the file's units, along the camera's axis, of a wide camera the distance; 0 where nothing is.
        confidence: [H, W] in [0, 1]; None if it was not measured.
    """

    run: "RenderableScene"
    camera: Camera
    camera_in_file: Camera
    hdr: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    confidence: np.ndarray | None


def render_images(run: "RenderableScene", camera: Camera, transform: WorldTransform) -> ViewImages:
    """Render a view from a camera in the scene's coordinates; `transform` leads to those of the file."""
    view, confidence = run.render(camera), run.render_confidence(camera)
    confidence = None if confidence is None else as_array(confidence)
    hdr, alpha, depth = (as_array(values) for values in (view.hdr, view.alpha, view.depth))
    depth = depth * np.float32(transform.scale)
    return ViewImages(run, camera, transform.camera(camera), hdr, alpha, depth, confidence)
