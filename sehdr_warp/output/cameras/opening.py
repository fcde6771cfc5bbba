"""First view of pages and of the viewer: a camera that shows the subject, and the scene's cameras as plain values."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...scene import Camera
from ...scene.camera_focus import camera_axes, camera_positions, common_focus
from ...scene.gravity import up_direction
from ...subsets import evenly
from ..world_transform import scene_up, world_transform
from .framing import (
    MOST_ZOOM,
    NEAR,
    SMALL,
    WIDESCREEN_SIZES,
    nearest_depth,
    subject_radius,
    subject_tangent,
    visible_surface,
    widescreen_camera,
)
from .paths import look_at_pose, moved, walk
from .scene_cameras import middle_index, split_or_all, surround

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

_OPENINGS, _WITNESSES = 16, 32  # Photos whose views may be the opening one, and photos that these are compared with
_SEVERAL = 3  # Photos that must show a point for it to count as shown
# Weights of an opening view beside the share of its picture that several photos show: minus the distance to the middle
# of the photos over their extent, plus the cosine to their mean axis, plus the part of the subject that it holds.
_ASIDE, _TURNED, _WHOLE = 0.4, 0.4, 0.8
# Distances of a view of Gaussians without cameras, over the radius that holds half of them, and its height over these.
_OUTSIDE, _ABOVE, _OUTSIDE_FOV = (2.8, 2.0, 1.3, 0.8, 0.5), 0.15, math.radians(50)
_FRAMED = 0.6  # Part of half a photo's field of view within which the focus lies in a photo that framed its subject
_CLOSER = 0.6  # Tangent of the field of view of an opening view, at least this part of its photo's
_STEEP = 0.9  # Sine of the pitch from which a camera looks down, and level is not a direction of its picture


def opening_view(run: "RenderableScene") -> Camera | None:
    """Return the camera that pages and the viewer open with; None if all photos are wider than pinholes.

    It stands where a photo was taken, in 16:9 and level, and looks where the photo looks or at the middle of what the
    photos look at, with a lens that holds the subject: wider than of a close-up, narrower than of a photo from afar. Of
    several photos that is taken whose picture shows most of what at least three photos show. A walk ahead is opened at
    its start. Gaussians without cameras are looked at from outside.
    """
    photos = split_or_all(run, "train")
    if not photos:
        return _view_from_outside(run)
    photos = [camera for camera in photos if camera.is_pinhole]
    if not photos:
        return None
    if way := walk(photos):
        return widescreen_camera(way[0], photos)
    up, focus = scene_up(run), common_focus(photos)
    radius = None if focus is None else subject_radius(run, photos, focus)
    positions = camera_positions(photos)
    middle, extent = np.median(positions, axis=0), max(float(np.linalg.norm(np.ptp(positions, axis=0))), 1e-12)
    common = np.mean(camera_axes(photos, 2), axis=0)
    witnesses = evenly(photos, _WITNESSES)

    def score(camera: Camera) -> float:
        coverage = _visible_share(run, camera.within(SMALL), witnesses)
        aside = float(np.linalg.norm(camera.position - middle)) / extent
        whole = 1.0
        if focus is not None and radius is not None:
            distance = float(np.linalg.norm(focus - camera.position))
            whole = min(1.0, camera.height / 2 / camera.fy * distance / radius)
        return coverage - _ASIDE * aside + _TURNED * float(camera.world_to_camera[2, :3] @ common) + _WHOLE * whole

    return max((_opening_of(camera, photos, up, focus, radius) for camera in evenly(photos, _OPENINGS)), key=score)


def opening_facts(run: "RenderableScene") -> dict[str, Any]:
    """Return the opening view as a page needs it: `opening`, and for Gaussians without cameras `focus` and `size`."""
    camera = opening_view(run)
    facts: dict[str, Any] = {"opening": None if camera is None else camera.to_dict()}
    if camera is not None and not run.cameras:
        focus = _focus_without_cameras(run)
        facts |= {"focus": focus.tolist(), "size": float(np.linalg.norm(focus - camera.position))}
    return facts


def camera_facts(entries: Sequence[Any]) -> dict[str, Any]:
    """Return what a page needs to fly through a scene, as plain values.

    `up` and `focus` are [3] (focus may be None), `size` is the extent of the camera positions, `views` lists name,
    split and camera, and `first` is the index of the view in the middle.
    """
    cameras = [entry.camera for entry in entries]
    focus, up, size = None, np.array([0.0, -1.0, 0.0]), 0.0
    if cameras:
        focus, size = common_focus(cameras), float(np.linalg.norm(np.ptp(camera_positions(cameras), axis=0)))
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


def _focus_without_cameras(run: "RenderableScene") -> np.ndarray:
    """Return the point [3] that most photos looked at if the file tells it, or else the middle of the Gaussians."""
    if run.world_matrix is not None:
        return np.zeros(3)  # Upright files have it as their origin.
    return np.median(_means(run), axis=0)


def _means(run: "RenderableScene") -> np.ndarray:
    return run.field.normalization.scene_points(run.field.gaussians.means.detach().cpu().numpy())


def _view_from_outside(run: "RenderableScene") -> Camera:
    """Return a camera for Gaussians without cameras, from as far away as nothing stands before their middle.

    It looks ahead as upright files do, where the photos' middle camera looks along +Z.
    """
    focus = _focus_without_cameras(run)
    radius = max(float(np.median(np.linalg.norm(_means(run) - focus, axis=1))), 1e-6)
    _, up, forward = world_transform(run).rotation
    width, height = WIDESCREEN_SIZES[1]
    focal = height / 2 / math.tan(_OUTSIDE_FOV / 2)
    for part in _OUTSIDE:
        position = focus + radius * (-part * forward + _ABOVE * part * up)
        pose = np.linalg.inv(look_at_pose(position, focus, up))
        camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
        if nearest_depth(run, camera) >= NEAR * part * radius:
            break
    return camera


def _opening_of(
    photo: Camera, photos: Sequence[Camera], up: np.ndarray, focus: np.ndarray | None, radius: float | None
) -> Camera:
    """Return the opening view from a photo's place; see opening_view."""
    camera = widescreen_camera(photo, photos)
    around = focus is not None and surround(photos, focus, up)
    own = photo.world_to_camera[2, :3]
    ahead = own if focus is None else focus - photo.position
    distance = float(np.linalg.norm(ahead))
    if not around and own @ ahead > distance * math.cos(_FRAMED * math.atan(photo.height / 2 / photo.fy)):
        ahead = own * distance
    if abs(ahead @ up) < _STEEP * distance:
        camera = moved(camera, look_at_pose(photo.position, photo.position + ahead, up))
    if focus is None or radius is None:
        return camera
    present = camera.height / 2 / camera.fy
    most = MOST_ZOOM * present if around else max(photo.height / 2 / photo.fy, present)
    zoom = present / max(min(subject_tangent(radius, distance), most), _CLOSER * present)
    return replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)


def _visible_share(run: "RenderableScene", camera: Camera, witnesses: Sequence[Camera]) -> float:
    """Return the share of a picture whose surface several other cameras have in their pictures."""
    points, _ = visible_surface(run, camera)
    if not len(points):
        return 0.0
    counts = np.sum([witness.project(points).inside for witness in witnesses], axis=0)
    return float((counts >= min(_SEVERAL, len(witnesses))).sum() / camera.pixel_count)
