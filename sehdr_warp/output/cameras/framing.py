"""Camera paths that show the subject: framed whole, in a film's format, and not from behind a wall."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...scene import Camera
from ...subsets import evenly
from ..images.ldr_files import as_array
from ..world_transform import scene_up, world_transform
from .paths import common_focus, look_at_pose, moved, orbit, surround, training_cameras, walk, walk_path

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

log = logging.getLogger(__name__)
FILM_SIZES = ((640, 360), (1280, 720), (1920, 1080))
"""Sizes of a path that states none, 16:9: the first that is as high as the photos' short side."""
_WIDEST = math.radians(75)  # Vertical field of view to which a path opens for its subject
_MOST_ZOOM = 2.0  # Times that it then shows more than the photos do: photos show most of a subject, fog looks larger
_MARGIN = 1.25  # Of the picture around the subject, whose surface is thick


def film_size(photos: Sequence[Camera]) -> tuple[int, int]:
    """Return width and height for a path among photos: 16:9, at least as high as their short side, at most 1080."""
    short = float(np.median([min(camera.width, camera.height) for camera in photos]))
    return next((size for size in FILM_SIZES if size[1] >= short), FILM_SIZES[-1])


_VIEWS, _SIZE = 12, 96  # Renders that the subject is found on; longest side of these and of the checks for obstacles
_NEAR, _BLOCKED = 0.3, 10  # A view is blocked if this per cent of its middle is nearer than this part of the distance
_REACH = 0.7  # Surfaces within this part of the cameras' distance from the focus are the subject
_EXTENT = 90  # Percentile of their distances from the focus that the picture holds


def subject_radius(run: "RenderableScene", photos: Sequence[Camera], focus: np.ndarray) -> float | None:
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
    if not camera.is_pinhole:
        focal = height / 2 / math.tan(_WIDEST / 2)
        return Camera(width, height, focal, focal, width / 2, height / 2, camera.world_to_camera)
    scale = max(width / camera.width, height / camera.height)
    shift = np.array([camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5])
    cx, cy = width / 2 + shift[0] * camera.width * scale, height / 2 + shift[1] * camera.height * scale
    return replace(camera, width=width, height=height, fx=camera.fx * scale, fy=camera.fy * scale, cx=cx, cy=cy)


def default_path(run: "RenderableScene", count: int, up: str | Sequence[float] | None = None) -> list[Camera]:
    """Return the path of `--cameras orbit`: around what the photos look at, or along them if they walk ahead.

    Args:
        run: The scene; its training cameras show what a path may show.
        count: Number of cameras on the path.
        up: As in world_transform.

    Raises:
        SehdrError: Without training cameras, or for a count outside 1 to 100 000.
    """
    photos = training_cameras(run)
    if way := walk(photos):
        log.info("the photos walk ahead, so the path goes along %d of %d of them", len(way), len(photos))
        return [film_camera(camera, photos) for camera in walk_path(way, count)]
    path = orbit(photos, count, _focus_distance(run, photos), scene_up(run, up))
    return frame_subject(run, [film_camera(camera, photos) for camera in path], photos)


_OPENINGS, _WITNESSES = 16, 32  # Photos whose views may be the opening one, and photos that these are compared with
_SEVERAL = 3  # Photos that must show a point for it to count as shown
# Weights of an opening view beside the share of its picture that several photos show: minus the distance to the middle
# of the photos over their extent, plus the cosine to their mean axis, plus the part of the subject that it holds.
_ASIDE, _TURNED, _WHOLE = 0.4, 0.4, 0.8


def opening_view(run: "RenderableScene") -> Camera | None:
    """Return the camera that pages and the viewer open with; None if all photos are wider than pinholes.

    It stands where a photo was taken, in 16:9 and level, and looks where the photo looks or at the middle of what the
    photos look at, with a lens that holds the subject: wider than of a close-up, narrower than of a photo from afar. Of
    several photos that is taken whose picture shows most of what at least three photos show. A walk ahead is opened at
    its start. Gaussians without cameras are looked at from outside.
    """
    photos = training_cameras(run) or [entry.camera for entry in run.cameras]
    if not photos:
        return _view_from_outside(run)
    photos = [camera for camera in photos if camera.is_pinhole]
    if not photos:
        return None
    if way := walk(photos):
        return film_camera(way[0], photos)
    up, focus = scene_up(run), common_focus(photos)
    radius = None if focus is None else subject_radius(run, photos, focus)
    positions = np.stack([camera.position for camera in photos])
    middle, extent = np.median(positions, axis=0), max(float(np.linalg.norm(np.ptp(positions, axis=0))), 1e-12)
    common = np.mean([camera.world_to_camera[2, :3] for camera in photos], axis=0)
    witnesses = evenly(photos, _WITNESSES)

    def score(camera: Camera) -> float:
        coverage = _visible_share(run, camera.within(_SIZE), witnesses)
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


def _focus_without_cameras(run: "RenderableScene") -> np.ndarray:
    """Return the point [3] that most photos looked at if the file tells it, or else the middle of the Gaussians."""
    if run.world_matrix is not None:
        return np.zeros(3)  # Upright files have it as their origin.
    return np.median(_means(run), axis=0)


def _means(run: "RenderableScene") -> np.ndarray:
    return run.field.normalization.scene_points(run.field.gaussians.means.detach().cpu().numpy())


# Distances of a view of Gaussians without cameras, over the radius that holds half of them, and its height over these.
_OUTSIDE, _ABOVE, _OUTSIDE_FOV = (2.8, 2.0, 1.3, 0.8, 0.5), 0.15, math.radians(50)


def _view_from_outside(run: "RenderableScene") -> Camera:
    """Return a camera for Gaussians without cameras, from as far away as nothing stands before their middle.

    It looks ahead as upright files do, where the photos' middle camera looks along +Z.
    """
    focus = _focus_without_cameras(run)
    radius = max(float(np.median(np.linalg.norm(_means(run) - focus, axis=1))), 1e-6)
    _, up, forward = world_transform(run).rotation
    width, height = FILM_SIZES[1]
    focal = height / 2 / math.tan(_OUTSIDE_FOV / 2)
    for part in _OUTSIDE:
        position = focus + radius * (-part * forward + _ABOVE * part * up)
        pose = np.linalg.inv(look_at_pose(position, focus, up))
        camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
        if _nearest_depth(run, camera) >= _NEAR * part * radius:
            break
    return camera


def _nearest_depth(run: "RenderableScene", camera: Camera) -> float:
    """Return the depth than which a tenth of the middle of a camera's picture is nearer; infinity if it is empty."""
    small = camera.within(_SIZE)
    rendered = run.render(small)
    rows, columns = (slice(side // 5, side - side // 5) for side in (small.height, small.width))
    depth = as_array(rendered.depth)[rows, columns]
    depth = depth[(depth > 0) & (as_array(rendered.alpha)[rows, columns] > 0.5)]
    return float(np.percentile(depth, _BLOCKED)) if depth.size else math.inf


_FRAMED = 0.6  # Part of half a photo's field of view within which the focus lies in a photo that framed its subject
_CLOSER = 0.6  # Tangent of the field of view of an opening view, at least this part of its photo's
_STEEP = 0.9  # Sine of the pitch from which a camera looks down, and level is not a direction of its picture


def _opening_of(
    photo: Camera, photos: Sequence[Camera], up: np.ndarray, focus: np.ndarray | None, radius: float | None
) -> Camera:
    """Return the opening view from a photo's place; see opening_view."""
    camera = film_camera(photo, photos)
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
    most = _MOST_ZOOM * present if around else max(photo.height / 2 / photo.fy, present)
    zoom = present / max(min(_subject_tangent(radius, distance), most), _CLOSER * present)
    return replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)


def _subject_tangent(radius: float, distance: float) -> float:
    """Return the tangent of half the field of view that holds a sphere with _MARGIN, at most that of _WIDEST."""
    return math.tan(min(math.asin(min(_MARGIN * radius / distance, 1.0)), _WIDEST / 2))


def _visible_share(run: "RenderableScene", camera: Camera, witnesses: Sequence[Camera]) -> float:
    """Return the share of a picture whose surface several other cameras have in their pictures."""
    points = _surface(run, camera)
    if not len(points):
        return 0.0
    counts = np.sum([witness.project(points).inside for witness in witnesses], axis=0)
    return float((counts >= min(_SEVERAL, len(witnesses))).sum() / (camera.width * camera.height))


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
    most = _MOST_ZOOM * present if around else max(photo, present)
    farthest = np.percentile([np.linalg.norm(each.position - focus) for each in photos], 50 if around else 75)
    cleared = _far_enough(cleared, focus, min(_MARGIN * radius / math.sin(math.atan(most)), float(farthest)))
    distance = min(float(np.linalg.norm(camera.position - focus)) for camera in cleared)
    zoom = present / min(max(present, _subject_tangent(radius, distance)), most)
    return [replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom) for camera in cleared]


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
        near = min(_nearest_depth(run, camera), distance)
        room = max(distance - 1.2 * radius, 0.0)  # It stays in front of the subject.
        advance.append(min(1.2 * near, room) / distance if near < _NEAR * distance else 0.0)
    if not any(advance):
        return list(path)
    width = max(3, len(checked) // 12)
    smooth = gaussian_filter1d(maximum_filter1d(advance, 2 * width + 1, mode="wrap"), width / 2, mode="wrap")
    parts = np.interp(np.linspace(0, len(checked) - 1, len(path)), np.arange(len(checked)), smooth)
    blocked = np.count_nonzero(advance)
    log.info("orbit: something near blocked %d of %d views; they come in front of it", blocked, len(checked))
    result = []
    for camera, part in zip(path, parts, strict=True):
        place = camera.position + part * (focus - camera.position)
        result.append(moved(camera, look_at_pose(place, focus, -camera.world_to_camera[1, :3])))
    return result


def _focus_distance(run: "RenderableScene", cameras: Sequence[Camera]) -> float:
    """Return the median depth in a small render of the middle camera; 1 if it is empty."""
    if not cameras:
        return 1.0
    depth = as_array(run.render(cameras[len(cameras) // 2].within(_SIZE)).depth)
    depth = depth[depth > 0]
    return float(np.median(depth)) if depth.size else 1.0


def _surface(run: "RenderableScene", camera: Camera) -> np.ndarray:
    """Return points [N, 3] of the surface that a camera shows."""
    rendered = run.render(camera)
    depth, alpha = as_array(rendered.depth), as_array(rendered.alpha)
    row, column = np.nonzero((depth > 0) & (alpha > 0.5))
    return camera.unproject(column + 0.5, row + 0.5, depth[row, column])
