"""Figures of photos and cameras, by which a training is planned."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..scene import Camera, Scene, View, encoded_values
from ..scene.images.exif import are_camera_files
from ..scene.images.ldr_files import file_kind
from ..scene.wide_camera import perspective_cameras, perspective_views
from ..subsets import every_nth
from .initialization import focus_distance, points_on_rays
from .training_views import pixel_bytes

SAMPLES = 2000  # Number of points at which overlap and visibility are measured
FEWEST_POINTS = 100  # With fewer sparse points, these are points along the cameras' rays
MOST_PIXELS = 250_000  # Largest number of pixels that are read from a photo
LARGE_SCENE = 0.1  # A scene is large if its photos contain less than this part of its points, in the mean
MOST_VIEWS = 64  # Largest number of photos whose codes are read; cameras are read of all
LOWEST_PLATEAU = 200  # Lowest code, of 255, that photos clip at below white, as after an edit
PLATEAU_CODES = 3  # Over which JPEG spreads most of the clipped pixels
PLATEAU_SHARE, PLATEAU_EXCESS = 1e-3, 3.0  # Least part of the pixels that they hold, and multiple of the codes below
RINGING = 8  # Codes above white that JPEG hardly reaches at the edges of clipped areas
MOST_RINGING = 0.1  # Of the clipped pixels that are brighter still


class PointFacts(NamedTuple):
    """Figures of a scene's points that a training uses; None where they are to be measured."""

    large_scene: bool | None = None  # Whether photos show little of the scene, see is_large()
    median_depth: float | None = None  # Depth around which photos are matched, see initialization.depth_of_points()


@dataclass(frozen=True)
class SceneFacts:
    """Figures of a scene's training views; fractions are of 1, and of the pixels that masks keep."""

    photos: int  # Number of photos
    pixels: int  # Pixels of all photos
    from_camera: bool  # Whether a camera wrote the files
    truths: int  # Number of photos with HDR truth
    points: int  # Number of sparse points
    visibility: float  # Mean number of photos whose field of view contains a sampled point
    # Fraction of the sampled points, or of points along the cameras' rays if that is more, that two photos contain
    overlap: float
    clipped: float  # Fraction of pixels with a channel at white
    black: float  # Fraction of pixels with all channels at 0
    contrast: float  # Standard deviation of all encoded values
    # Approximate stops between the darkest and the brightest photo's median if no exposure times are known; else 0
    drift: float
    light_known: bool = False  # Whether the photos hold light itself: RAW, linear, float
    unclipped: bool = False  # Whether they are float pictures without clipping
    plateau: int = 0  # Code of 255, below 255, at which the photos clip, as after an edit; 0 if they do not
    pixel_bytes: int = 3  # Bytes of a pixel of the photos on a device, with its mask
    clipped_when_dark: float = 0.0  # As `clipped`, of the photos with the shortest exposures, three or more
    focal_ratio: float = 1.0  # Of focal lengths in pixels: the 90th percentile over the 10th


def measure_scene(scene: Scene, seed: int = 0) -> SceneFacts:
    """Measure a scene with at least one training view; `seed` is that of the sampled points."""
    photos, views = scene.train_views, perspective_views(scene.train_views)
    cameras = [view.camera for view in views]
    samples, ray_points = _sample_points(scene, cameras, seed)
    visible, on_rays = (_in_view(cameras, points).sum(0) for points in (samples, ray_points))
    read_views = every_nth(views, MOST_VIEWS)
    figures = _photo_statistics(read_views)
    clipped, black, mean, square, _ = map(float, figures.mean(0))
    longest = 2 * sorted(view.exposure_time for view in photos)[:3][-1]
    dark_views = every_nth([view for view in views if view.exposure_time <= longest], MOST_VIEWS)
    return SceneFacts(
        photos=len(photos),
        pixels=sum(view.camera.pixel_count for view in photos),
        from_camera=are_camera_files([view.source for view in photos]),
        truths=sum(view.hdr is not None for view in photos),
        points=len(scene.points),
        visibility=float(visible[visible > 0].mean()) if visible.any() else 0.0,
        overlap=max(float((count >= 2).mean()) for count in (visible, on_rays)),
        clipped=clipped,
        black=black,
        contrast=float(np.sqrt(max(square - mean**2, 0.0))),
        drift=0.0 if scene.exposure_times_known else float(np.ptp(figures[:, -1])),
        light_known=scene.light_known,
        unclipped=scene.light_known and all(view.source and file_kind(view.source) == "float" for view in views),
        plateau=0 if scene.light_known else _plateau(read_views),
        pixel_bytes=pixel_bytes(photos),
        clipped_when_dark=float(_photo_statistics(dark_views)[:, 0].mean()),
        focal_ratio=focal_ratio(cameras),
    )


def focal_ratio(cameras: Sequence[Camera]) -> float:
    """Return how much finer some cameras resolve a place from one distance than others: SceneFacts.focal_ratio."""
    shortest, longest = np.quantile([math.sqrt(camera.fx * camera.fy) for camera in cameras], [0.1, 0.9])
    return float(longest / shortest)


def is_large(scene: Scene) -> bool:
    """Return whether photos show so little of a scene that many steps pass before a Gaussian is seen again.

    The figure is the mean fraction of the sampled points that a training photo contains, occlusion not considered.
    """
    cameras = perspective_cameras(view.camera for view in scene.train_views)
    return float(_in_view(cameras, _sample_points(scene, cameras, 0)[0]).mean()) < LARGE_SCENE


def _sample_points(scene: Scene, cameras: Sequence[Camera], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a sample [P, 3] of the sparse points, if there are enough, and points [Q, 3] along the cameras' rays."""
    rng = np.random.default_rng(seed)
    samples = ray_points = points_on_rays(cameras, SAMPLES, focus_distance(cameras), rng)
    if len(scene.points) >= FEWEST_POINTS:
        count = min(SAMPLES, len(scene.points))
        samples = np.asarray(scene.points)[rng.choice(len(scene.points), count, replace=False)]
    return samples, ray_points


def _in_view(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """Return which cameras [V, P] show which points [P, 3]."""
    return np.array([camera.project(points).inside for camera in cameras])


def _photo_statistics(views: Sequence[View]) -> np.ndarray:
    """Return statistics [photos, 5] of photos: clipped and black fractions, mean, mean square, and the median's light.

    The mean is of encoded values, the light is in stops, by a gamma of 2.2. Pixels that masks leave out do not count,
    nor do photos that masks leave out as a whole, unless they are all.
    """

    def statistics(values: np.ndarray) -> tuple[float, float, float, float, float]:
        clipped, black = (values >= 254.5 / 255).any(1).mean(), (values <= 0.5 / 255).all(1).mean()
        median = 2.2 * math.log2(max(float(np.median(values)), 0.5 / 255))
        return clipped, black, values.mean(dtype=np.float64), np.square(values, dtype=np.float64).mean(), median

    rows = [statistics(values) for view in views if len(values := _sampled(view))]
    return np.array(rows or [statistics(_sampled(replace(view, mask=None))) for view in views])


def _sampled(view: View) -> np.ndarray:
    """Return the encoded values [N, 3] of a photo inside its mask, sampled on a grid if it has over MOST_PIXELS."""
    step = max(1, round((view.camera.pixel_count / MOST_PIXELS) ** 0.5))
    values = encoded_values(view.codes[::step, ::step])
    return values.reshape(-1, 3) if view.mask is None else values[view.mask[::step, ::step] > 0.5]


def _plateau(views: Sequence[View]) -> int:
    """Return the code of 255, below 255, that many pixels of the photos have and hardly any exceeds; 0 without one."""
    counts = np.zeros(256 + RINGING)
    for view in views:
        brightest = _sampled(view).max(1)
        counts += np.bincount(np.rint(255 * brightest).astype(np.int64), minlength=len(counts))
    code = LOWEST_PLATEAU + int(counts[LOWEST_PLATEAU:256].argmax())
    middle = code - PLATEAU_CODES // 2
    below, at, above = (
        counts[middle + offset :][:PLATEAU_CODES].sum() for offset in (-PLATEAU_CODES, 0, PLATEAU_CODES)
    )
    is_peak = at >= PLATEAU_SHARE * counts.sum() and at >= PLATEAU_EXCESS * below and at >= above
    return code if is_peak and code < 255 and counts[code + RINGING :].sum() <= MOST_RINGING * at else 0
