"""Camera paths that show the subject: framed whole, in 16:9, and not from behind a wall."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...scene import Camera
from ...scene.camera_focus import common_focus
from ...scene.wide_camera import surface_points
from ...subsets import evenly
from ..world_transform import scene_up
from .paths import look_at_pose, moved, orbit, walk, walk_path
from .scene_cameras import surround, training_cameras

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

log = logging.getLogger(__name__)
WIDESCREEN_SIZES = ((640, 360), (1280, 720), (1920, 1080))
"""Sizes of views that state none, 16:9: the first that is as high as the photos' short side."""
_WIDEST = math.radians(75)  # Vertical field of view to which a path opens for its subject
MOST_ZOOM = 2.0  # Times that it then shows more than the photos do: photos show most of a subject, fog looks larger
_MARGIN = 1.25  # Of the picture around the subject, whose surface is thick
_VIEWS, SMALL = 12, 96  # Renders that the subject is found on; longest side of these and of the checks for obstacles
NEAR, _BLOCKED = 0.3, 10  # A view is blocked if this per cent of its middle is nearer than this part of the distance
_REACH = 0.7  # Surfaces within this part of the cameras' distance from the focus are the subject
_EXTENT = 90  # Percentile of their distances from the focus that the picture holds


def widescreen_size(photos: Sequence[Camera]) -> tuple[int, int]:
    """Return width and height for views among photos: 16:9, at least as high as their short side, at most 1080."""
    short = float(np.median([min(camera.width, camera.height) for camera in photos]))
    return next((size for size in WIDESCREEN_SIZES if size[1] >= short), WIDESCREEN_SIZES[-1])


def widescreen_camera(camera: Camera, photos: Sequence[Camera]) -> Camera:
    """Return a camera of widescreen_size and square pixels that shows no more at the sides than photos do."""
    width, height = widescreen_size(photos)
    if not camera.is_pinhole:
        focal = height / 2 / math.tan(_WIDEST / 2)
        return Camera(width, height, focal, focal, width / 2, height / 2, camera.world_to_camera)
    focal = max(width / camera.width * camera.fx, height / camera.height * camera.fy)
    cx = width / 2 + (camera.cx - camera.width / 2) / camera.fx * focal
    cy = height / 2 + (camera.cy - camera.height / 2) / camera.fy * focal
    return replace(camera, width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy)


def default_path(run: "RenderableScene", count: int, up: str | Sequence[float] | None = None) -> list[Camera]:
    """Return the path of `--cameras orbit`: around what the photos look at, or along them if they walk ahead.

    Raises SehdrError without training cameras, or for a count outside 1 to 100 000. up: as in world_transform.
    """
    photos = training_cameras(run)
    if way := walk(photos):
        log.info("the photos walk ahead, so the path follows %d of %d of them", len(way), len(photos))
        return [widescreen_camera(camera, photos) for camera in walk_path(way, count)]
    path = orbit(photos, count, _focus_distance(run, photos), scene_up(run, up))
    return frame_subject(run, [widescreen_camera(camera, photos) for camera in path], photos)


def frame_subject(run: "RenderableScene", path: Sequence[Camera], photos: Sequence[Camera]) -> list[Camera]:
    """Return a path around the photos' focus whose pictures hold the whole subject and are not blocked.

    The lens opens until the sphere of subject_radius fits, to at most 75 degrees: up to twice the picture if photos
    surround the focus, else up to their height, because wider pictures would show what no photo does. Cameras behind
    a wall or in a floater come forward, smoothly along the path. Those too near for the subject step back, as far as
    half of the photos stand, or a quarter of them if the lens may not open. `photos` are the training cameras.
    """
    focus = common_focus(photos)
    radius = None if focus is None else subject_radius(run, photos, focus)
    if focus is None or radius is None:
        return list(path)
    cleared = _in_front_of_obstacles(run, path, focus, radius)
    # Tangents of half the vertical fields of view
    present = path[0].height / 2 / path[0].fy
    photo = float(np.median([camera.height / 2 / camera.fy for camera in photos]))
    around = surround(photos, focus)
    most = MOST_ZOOM * present if around else max(photo, present)
    farthest = np.percentile([np.linalg.norm(each.position - focus) for each in photos], 50 if around else 75)
    cleared = _far_enough(cleared, focus, min(_MARGIN * radius / math.sin(math.atan(most)), float(farthest)))
    distance = min(float(np.linalg.norm(camera.position - focus)) for camera in cleared)
    zoom = present / min(max(present, subject_tangent(radius, distance)), most)
    return [replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom) for camera in cleared]


def subject_radius(run: "RenderableScene", photos: Sequence[Camera], focus: np.ndarray) -> float | None:
    """Return the radius around the focus that holds most of what the photos look at; None if nothing is there."""
    distances = []
    reach = _REACH * float(np.median([np.linalg.norm(camera.position - focus) for camera in photos]))
    for camera in evenly(photos, _VIEWS):
        points, _ = visible_surface(run, camera.within(SMALL))
        offsets = np.linalg.norm(points - focus, axis=1)
        distances.append(offsets[offsets < reach])
    radii = np.concatenate(distances)
    return float(np.percentile(radii, _EXTENT)) if radii.size else None


def subject_tangent(radius: float, distance: float) -> float:
    """Return the tangent of half the field of view that holds a sphere with _MARGIN, at most that of _WIDEST."""
    return math.tan(min(math.asin(min(_MARGIN * radius / distance, 1.0)), _WIDEST / 2))


def _far_enough(path: Sequence[Camera], focus: np.ndarray, least: float) -> list[Camera]:
    """Return the cameras, moved away from the focus to at least this distance."""
    result = []
    for camera in path:
        offset = camera.position - focus
        pose = camera.camera_to_world.copy()
        pose[:3, 3] = focus + offset * max(1.0, least / max(float(np.linalg.norm(offset)), 1e-12))
        result.append(moved(camera, pose))
    return result


def _in_front_of_obstacles(
    run: "RenderableScene", path: Sequence[Camera], focus: np.ndarray, radius: float
) -> list[Camera]:
    """Return the cameras, moved towards the focus if what is near fills the middle of their pictures."""
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    checked = evenly(path, 60)
    advance = []
    for camera in checked:
        distance = float(np.linalg.norm(camera.position - focus))
        near = min(nearest_depth(run, camera), distance)
        room = max(distance - 1.2 * radius, 0.0)  # It stays in front of the subject.
        advance.append(min(1.2 * near, room) / distance if near < NEAR * distance else 0.0)
    if not any(advance):
        return list(path)
    width = max(3, len(checked) // 12)
    smooth = gaussian_filter1d(maximum_filter1d(advance, 2 * width + 1, mode="wrap"), width / 2, mode="wrap")
    parts = np.interp(np.linspace(0, len(checked) - 1, len(path)), np.arange(len(checked)), smooth)
    blocked = np.count_nonzero(advance)
    log.info("orbit: something near blocked %d of %d views; these cameras move in front of it", blocked, len(checked))
    result = []
    for camera, part in zip(path, parts, strict=True):
        place = camera.position + part * (focus - camera.position)
        result.append(moved(camera, look_at_pose(place, focus, -camera.world_to_camera[1, :3])))
    return result


def nearest_depth(run: "RenderableScene", camera: Camera) -> float:
    """Return the depth than which a tenth of the middle of a camera's picture is nearer; infinity if it is empty."""
    small = camera.within(SMALL)
    rendered = run.render(small, supersample=False)
    rows, columns = (slice(side // 5, side - side // 5) for side in (small.height, small.width))
    depth = rendered.depth.cpu().numpy()[rows, columns]
    depth = depth[(depth > 0) & (rendered.alpha.cpu().numpy()[rows, columns] > 0.5)]
    return float(np.percentile(depth, _BLOCKED)) if depth.size else math.inf


def _focus_distance(run: "RenderableScene", cameras: Sequence[Camera]) -> float:
    """Return the median depth in a small render of the middle camera; 1 if it is empty."""
    if not cameras:
        return 1.0
    depth = run.render(cameras[len(cameras) // 2].within(SMALL), supersample=False).depth.cpu().numpy()
    depth = depth[depth > 0]
    return float(np.median(depth)) if depth.size else 1.0


def visible_surface(run: "RenderableScene", camera: Camera, least_alpha: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return points [N, 3] of the surface that a camera shows, and their radiance [N, 3]."""
    rendered = run.render(camera, supersample=False)
    depth, alpha = rendered.depth.cpu().numpy(), rendered.alpha.cpu().numpy()
    visible = (depth > 0) & (alpha > least_alpha)
    return surface_points(camera, depth)[visible], rendered.hdr.cpu().numpy()[visible]
