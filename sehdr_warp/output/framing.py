"""Camera paths that show the subject: framed whole, in a film's format, and not from behind a wall."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sehdr_warp.scene import Camera

from .camera_paths import common_focus, evenly, look_at_pose, surround
from .images import as_array

if TYPE_CHECKING:
    from ..runs.run import LoadedScene

log = logging.getLogger(__name__)
FILM_SIZES = ((640, 360), (1280, 720), (1920, 1080))
"""Sizes of a path that states none, 16:9: the first that is as high as the photos' short side."""
_WIDEST = math.radians(75)  # Vertical field of view to which a path opens for its subject
_MOST_ZOOM = 2.0  # Times that it then shows more than the photos do: photos show most of a subject, fog looks larger
_MARGIN = 1.25  # Of the picture around the subject, whose surface is thick
_VIEWS, _SIZE = 12, 96  # Renders that the subject is found on; longest side of these and of the checks for obstacles
_REACH = 0.7  # Surfaces within this part of the cameras' distance from the focus are the subject
_EXTENT = 90  # Percentile of their distances from the focus that the picture holds
_NEAR, _BLOCKED = 0.3, 10  # A view is blocked if this per cent of its middle is nearer than this part of the distance


def film_size(photos: Sequence[Camera]) -> tuple[int, int]:
    """Return width and height for a path among photos: 16:9, at least as high as their short side, at most 1080."""
    short = float(np.median([min(camera.width, camera.height) for camera in photos]))
    return next((size for size in FILM_SIZES if size[1] >= short), FILM_SIZES[-1])


def subject_radius(run: "LoadedScene", photos: Sequence[Camera], focus: np.ndarray) -> float | None:
    """Return the radius around the focus that holds most of what the photos look at; None if nothing is there."""
    distances = []
    reach = _REACH * float(np.median([np.linalg.norm(camera.position - focus) for camera in photos]))
    for camera in evenly(photos, _VIEWS):
        points = _surface(run, camera.within(_SIZE))
        offsets = np.linalg.norm(points - focus, axis=1)
        distances.append(offsets[offsets < reach])
    radii = np.concatenate(distances)
    return float(np.percentile(radii, _EXTENT)) if radii.size else None


def film_camera(camera: Camera, photos: Sequence[Camera]) -> Camera:
    """Return a camera of a path in film_size that shows no more at the sides than the photos do."""
    width, height = film_size(photos)
    scale = max(width / camera.width, height / camera.height)
    shift = np.array([camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5])
    cx, cy = width / 2 + shift[0] * camera.width * scale, height / 2 + shift[1] * camera.height * scale
    return replace(camera, width=width, height=height, fx=camera.fx * scale, fy=camera.fy * scale, cx=cx, cy=cy)


def frame_subject(run: "LoadedScene", path: Sequence[Camera], photos: Sequence[Camera]) -> list[Camera]:
    """Return a path around the photos' focus whose pictures hold the whole subject and are not blocked.

    The lens opens until the sphere of subject_radius fits, to at most 75 degrees: up to twice the picture if photos
    surround the focus, else up to their height, because wider pictures would show what no photo does. Cameras behind
    a wall or in a floater come forward, smoothly along the path. `photos` are the training cameras.
    """
    focus = common_focus(photos)
    radius = None if focus is None else subject_radius(run, photos, focus)
    if focus is None or radius is None:
        return list(path)
    cleared = _in_front_of_obstacles(run, path, focus, radius)
    distance = min(float(np.linalg.norm(camera.position - focus)) for camera in cleared)
    # Tangents of half the vertical fields of view
    present = path[0].height / 2 / path[0].fy
    needed = math.tan(min(math.asin(min(_MARGIN * radius / distance, 1.0)), _WIDEST / 2))
    photo = float(np.median([camera.height / 2 / camera.fy for camera in photos]))
    most = _MOST_ZOOM * present if surround(photos, focus) else max(photo, present)
    zoom = present / min(max(present, needed), most)
    return [replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom) for camera in cleared]


def _in_front_of_obstacles(
    run: "LoadedScene", path: Sequence[Camera], focus: np.ndarray, radius: float
) -> list[Camera]:
    """Return the cameras, moved towards the focus if what is near fills the middle of their pictures."""
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    checked = [path[i] for i in sorted({round(i) for i in np.linspace(0, len(path) - 1, min(len(path), 60))})]
    advance = []
    for camera in checked:
        small = camera.within(_SIZE)
        rendered = run.render(small)
        rows, columns = (slice(side // 5, side - side // 5) for side in (small.height, small.width))
        depth = as_array(rendered.depth)[rows, columns]
        depth = depth[(depth > 0) & (as_array(rendered.alpha)[rows, columns] > 0.5)]
        distance = float(np.linalg.norm(camera.position - focus))
        near = float(np.percentile(depth, _BLOCKED)) if depth.size else distance
        room = max(distance - 1.2 * radius, 0.0)  # It stays in front of the subject.
        advance.append(min(1.2 * near, room) / distance if near < _NEAR * distance else 0.0)
    if not any(advance):
        return list(path)
    width = max(3, len(checked) // 12)
    smooth = gaussian_filter1d(maximum_filter1d(advance, 2 * width + 1, mode="wrap"), width / 2, mode="wrap")
    parts = np.interp(np.linspace(0, len(checked) - 1, len(path)), np.arange(len(checked)), smooth)
    blocked = np.count_nonzero(advance)
    log.info("orbit: something near blocked %d of %d views; they come in front of it", blocked, len(checked))
    up = [-camera.world_to_camera[1, :3] for camera in path]
    positions = [camera.position + part * (focus - camera.position) for camera, part in zip(path, parts, strict=True)]
    poses = [look_at_pose(place, focus, direction) for place, direction in zip(positions, up, strict=True)]
    return [replace(camera, world_to_camera=np.linalg.inv(pose)) for camera, pose in zip(path, poses, strict=True)]


def _surface(run: "LoadedScene", camera: Camera) -> np.ndarray:
    """Return points [N, 3] of the surface that a camera shows."""
    rendered = run.render(camera)
    depth, alpha = as_array(rendered.depth), as_array(rendered.alpha)
    row, column = np.nonzero((depth > 0) & (alpha > 0.5))
    return camera.unproject(column + 0.5, row + 0.5, depth[row, column])
