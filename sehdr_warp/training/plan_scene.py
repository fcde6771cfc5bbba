"""What a plan rests on: a scene measured from its photos, cameras and points; and scenes that no plan fits."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..scene import Scene, View
from ..scene.exposure import made_by_camera
from .initialization import focus_distance, points_on_rays

PROBES = 2000
"""Places at which overlap, parallax and visibility are measured."""
FEWEST_POINTS = 100
"""With fewer sparse points places along the cameras' rays serve as probes."""
FEWEST_PHOTOS = 3
LEAST_OVERLAP = 0.02
"""Part of the places that must be in two photos' fields of view."""
LEAST_CONTRAST = 1 / 255
MOST_VIEWS = 64
"""Photos that codes are read from, evenly spread; geometry is of all."""


@dataclass(frozen=True)
class SceneFacts:
    """Figures of a scene's training views; parts are of 1.

    photos, held_out: views. width, height: of the largest photo, pixels. pixels: of all photos together.
    exposure_times: how many differ. times_known: whether files state them. from_camera: whether a camera made the
    files. truths: photos with HDR truth. points: sparse points.
    seen: mean number of photos whose field of view holds a probe (what stands in the way is not known).
    overlap: part of the probes, or of places along the cameras' rays if that is more, that two photos show.
    clipped, black: part of the pixels with a channel at 255, with all channels at 0. contrast: standard deviation of
    all codes.
    """

    photos: int
    held_out: int
    width: int
    height: int
    pixels: int
    exposure_times: int
    times_known: bool
    from_camera: bool
    truths: int
    points: int
    seen: float
    overlap: float
    clipped: float
    black: float
    contrast: float


def measure_scene(scene: Scene, seed: int = 0) -> SceneFacts:
    """The facts of a scene with at least one training view; takes a second or so, draws its probes from a seed."""
    views = scene.train_views
    rng = np.random.default_rng(seed)
    drawn = points_on_rays(views, PROBES, focus_distance(views), rng)
    probes = drawn
    if len(scene.points) >= FEWEST_POINTS:
        count = min(PROBES, len(scene.points))
        probes = np.asarray(scene.points)[rng.choice(len(scene.points), count, replace=False)]
    shown = visibility(probes, views)
    codes = [view.image for view in views[:: -(-len(views) // MOST_VIEWS)]]
    clipped, black = (
        float(np.mean([np.mean(marked(image)) for image in codes]))
        for marked in (lambda c: (c >= 254.5 / 255).any(2), lambda c: (c <= 0.5 / 255).all(2))
    )
    largest = max((view.camera for view in views), key=lambda camera: camera.width * camera.height)
    return SceneFacts(
        photos=len(views),
        held_out=len(scene.test_views),
        width=largest.width,
        height=largest.height,
        pixels=sum(view.camera.width * view.camera.height for view in views),
        exposure_times=len({view.exposure_time for view in views}),
        times_known=scene.exposure_times_known,
        from_camera=made_by_camera([view.source for view in views]),
        truths=sum(view.hdr is not None for view in views),
        points=len(scene.points),
        seen=_mean_where(shown.sum(0), shown.any(0)),
        overlap=max(float((other.sum(0) >= 2).mean()) for other in (shown, visibility(drawn, views))),
        clipped=clipped,
        black=black,
        contrast=float(np.sqrt(np.mean([image.var() for image in codes]) + np.var([image.mean() for image in codes]))),
    )


def check_scene(scene: Scene, facts: SceneFacts) -> None:
    """Raises InputError for a scene that no training can make sense of."""
    if facts.photos < FEWEST_PHOTOS:
        raise InputError(
            scene.name,
            f"{facts.photos} training photos: depth and light cannot be told apart from so few",
            f"take {FEWEST_PHOTOS} or more photos from different places, better 20",
        )
    if facts.contrast < LEAST_CONTRAST:
        raise InputError(
            scene.name,
            f"all photos show a single colour (standard deviation {255 * facts.contrast:.2f} of 255): nothing to match",
            "check that the files are the photos, and their exposure",
        )
    if facts.overlap < LEAST_OVERLAP:
        raise InputError(
            scene.name,
            f"the photos share no view: {facts.overlap:.1%} of the places that one shows are in the field of view of "
            "another",
            "check the poses and the axes' convention, or take photos that overlap by a half",
        )


def visibility(points: np.ndarray, views: tuple[View, ...]) -> np.ndarray:
    """[V, P] bool: whether a view's field of view holds a point [P, 3]; what stands in the way is not considered."""
    shown = np.zeros((len(views), len(points)), bool)
    for row, view in zip(shown, views, strict=True):
        x, y, depth = _project(points, view)
        row[:] = (depth > 0) & (x >= 0) & (x < view.camera.width) & (y >= 0) & (y < view.camera.height)
    return shown


def _project(points: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels x and y, and depth, of points [P, 3]; pixels are -1 behind the camera."""
    camera = view.camera
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = np.where(local[:, 2] > 1e-9, local[:, 2], np.nan)
    with np.errstate(invalid="ignore"):
        x, y = camera.fx * local[:, 0] / depth + camera.cx, camera.fy * local[:, 1] / depth + camera.cy
    return tuple(np.nan_to_num(values, nan=-1.0) for values in (x, y, depth))


def _mean_where(values: np.ndarray, chosen: np.ndarray) -> float:
    return float(values[chosen].mean()) if chosen.any() else 0.0
