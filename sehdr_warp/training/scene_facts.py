"""What a plan knows of a scene: figures of its photos and cameras, found in a second or so."""

import math
from dataclasses import dataclass

import numpy as np

from ..scene import Scene, View, encoded_values
from ..scene.exposure import are_camera_jpegs
from ..scene.linear_photos import kind_of
from ..scene.wide_camera import perspective_views
from .initialization import focus_distance, pixels_of, points_on_rays

PROBES = 2000  # Places at which overlap and visibility are measured
FEWEST_POINTS = 100  # With fewer sparse points places along the cameras' rays serve as probes
MOST_PIXELS = 250_000  # Of a photo, looked at
MOST_VIEWS = 64  # Photos that codes are read from, evenly spread; geometry is of all
MOST_GAZE, MOST_AHEAD = 0.3, 0.75
"""Below both, cameras look all around: eight captures of things, rooms and grounds have 0.5 to 1 of the first, and maps
from within 0.1; of the second things have nearly 1."""


@dataclass(frozen=True)
class SceneFacts:
    """Figures of a scene's training views; parts are of 1.

    pixels: of all photos together. from_camera: whether a camera made the files. truths: photos with HDR truth.
    points: sparse points. seen: mean number of photos whose field of view holds a probe.
    overlap: part of the probes, or of places along the cameras' rays if that is more, that two photos show.
    clipped, black: part of the pixels with a channel at white, with all at 0. contrast: deviation of all codes.
    light_known: the photos hold light itself: RAW, linear, float. unclipped: they are float pictures, with all of it.
    gaze: length of the mean viewing direction: 1 where all look the same way. ahead: part of the cameras that look
    towards the middle of all.
    drift: stops, about, between the darkest and the brightest photo's median where no exposure times are known; else 0.
    """

    photos: int
    pixels: int
    from_camera: bool
    truths: int
    points: int
    seen: float
    overlap: float
    clipped: float
    black: float
    contrast: float
    drift: float
    gaze: float = 1.0
    ahead: float = 1.0
    light_known: bool = False
    unclipped: bool = False

    @property
    def around(self) -> bool:
        """Whether the cameras look all around from within, as those of a room do, and not at a thing from its sides."""
        return self.gaze < MOST_GAZE and self.ahead < MOST_AHEAD


def measure_scene(scene: Scene, seed: int = 0) -> SceneFacts:
    """The facts of a scene with at least one training view; takes a second or so, draws its probes from a seed."""
    photos, views = scene.train_views, perspective_views(scene.train_views)
    rng = np.random.default_rng(seed)
    probes = drawn = points_on_rays(views, PROBES, focus_distance(views), rng)
    if len(scene.points) >= FEWEST_POINTS:
        count = min(PROBES, len(scene.points))
        probes = np.asarray(scene.points)[rng.choice(len(scene.points), count, replace=False)]
    shown, drawn = (np.array([pixels_of(points, view)[2] for view in views]).sum(0) for points in (probes, drawn))
    figures = np.array([_codes(view) for view in views[:: -(-len(views) // MOST_VIEWS)]])
    clipped, black, mean, square, _ = map(float, figures.mean(0))
    gaze, ahead = _gaze(np.stack([view.camera.world_to_camera for view in views]))
    return SceneFacts(
        photos=len(photos),
        pixels=sum(view.camera.width * view.camera.height for view in photos),
        from_camera=are_camera_jpegs([view.source for view in photos]),
        truths=sum(view.hdr is not None for view in photos),
        points=len(scene.points),
        seen=float(shown[shown > 0].mean()) if shown.any() else 0.0,
        overlap=max(float((count >= 2).mean()) for count in (shown, drawn)),
        clipped=clipped,
        black=black,
        contrast=float(np.sqrt(max(square - mean**2, 0.0))),
        drift=0.0 if scene.exposure_times_known else float(np.ptp(figures[:, -1])),
        gaze=gaze,
        ahead=ahead,
        light_known=scene.light_known,
        unclipped=scene.light_known and all(view.source and kind_of(view.source) == "float" for view in views),
    )


def _codes(view: View) -> tuple[float, float, float, float, float]:
    """Parts of the pixels that are clipped and black, the means of the encoded values and of their squares, and the
    median's light in stops, by a gamma of 2.2; of a photo of more than MOST_PIXELS, on a grid."""
    step = max(1, round((view.camera.width * view.camera.height / MOST_PIXELS) ** 0.5))
    image = encoded_values(view.codes[::step, ::step])
    clipped, black = (image >= 254.5 / 255).any(2).mean(), (image <= 0.5 / 255).all(2).mean()
    median = 2.2 * math.log2(max(float(np.median(image)), 0.5 / 255))
    return clipped, black, image.mean(dtype=np.float64), np.square(image, dtype=np.float64).mean(), median


def _gaze(poses: np.ndarray) -> tuple[float, float]:
    """SceneFacts.gaze and .ahead of cameras [V, 4, 4]."""
    forward = poses[:, 2, :3]
    places = -np.einsum("vij,vi->vj", poses[:, :3, :3], poses[:, :3, 3])
    inwards = np.einsum("vi,vi->v", places.mean(axis=0) - places, forward)
    return float(np.linalg.norm(forward.mean(axis=0))), float((inwards > 0).mean())
