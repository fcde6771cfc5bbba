"""What a plan rests on: a scene measured from its photos, cameras and points; and scenes that no plan fits."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..scene import Scene, View
from ..scene.exposure import made_by_camera
from .initialization import focus_distance, pixels_of, points_on_rays

PROBES = 2000
"""Places at which overlap and visibility are measured."""
FEWEST_POINTS = 100
"""With fewer sparse points places along the cameras' rays serve as probes."""
FEWEST_PHOTOS = 3
LEAST_OVERLAP = 0.02
LEAST_CONTRAST = 1 / 255
MOST_VIEWS = 64
"""Photos that codes are read from, evenly spread; geometry is of all."""


@dataclass(frozen=True)
class SceneFacts:
    """Figures of a scene's training views; parts are of 1.

    pixels: of all photos together. from_camera: whether a camera made the files. truths: photos with HDR truth.
    points: sparse points. seen: mean number of photos whose field of view holds a probe.
    overlap: part of the probes, or of places along the cameras' rays if that is more, that two photos show.
    clipped, black: part of the pixels with a channel at white, with all at 0. contrast: deviation of all codes.
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


def measure_scene(scene: Scene, seed: int = 0) -> SceneFacts:
    """The facts of a scene with at least one training view; takes a second or so, draws its probes from a seed."""
    views = scene.train_views
    rng = np.random.default_rng(seed)
    probes = drawn = points_on_rays(views, PROBES, focus_distance(views), rng)
    if len(scene.points) >= FEWEST_POINTS:
        count = min(PROBES, len(scene.points))
        probes = np.asarray(scene.points)[rng.choice(len(scene.points), count, replace=False)]
    shown, drawn = (np.array([pixels_of(points, view)[2] for view in views]).sum(0) for points in (probes, drawn))
    figures = np.mean([_light(view) for view in views[:: -(-len(views) // MOST_VIEWS)]], axis=0)
    clipped, black, mean, square = (float(figure) for figure in figures)
    return SceneFacts(
        photos=len(views),
        pixels=sum(view.camera.width * view.camera.height for view in views),
        from_camera=made_by_camera([view.source for view in views]),
        truths=sum(view.hdr is not None for view in views),
        points=len(scene.points),
        seen=float(shown[shown > 0].mean()) if shown.any() else 0.0,
        overlap=max(float((count >= 2).mean()) for count in (shown, drawn)),
        clipped=clipped,
        black=black,
        contrast=float(np.sqrt(max(square - mean**2, 0.0))),
    )


def _light(view: View) -> tuple[float, float, float, float]:
    """Parts of the pixels that are clipped and black, and the means of the encoded values and of their squares."""
    image = view.image
    clipped, black = (image >= 254.5 / 255).any(2).mean(), (image <= 0.5 / 255).all(2).mean()
    return clipped, black, image.mean(dtype=np.float64), np.square(image, dtype=np.float64).mean()


def check_scene(scene: Scene, facts: SceneFacts) -> None:
    """Raises InputError for a scene that no training can make sense of."""
    problem = None
    if facts.photos < FEWEST_PHOTOS:
        problem = f"{facts.photos} training photos: depth and light cannot be told apart from so few"
        remedy = f"take {FEWEST_PHOTOS} or more photos from different places, better 20"
    elif facts.contrast < LEAST_CONTRAST:
        spread = f"standard deviation {255 * facts.contrast:.2f} of 255"
        problem = f"all photos show a single colour ({spread}): nothing to match"
        remedy = "check that the files are the photos, and their exposure"
    elif facts.overlap < LEAST_OVERLAP:
        places = f"{facts.overlap:.1%} of the places that one shows"
        problem = f"the photos share no view: {places} are in the field of view of another"
        remedy = "check the poses and the axes' convention, or take photos that overlap by a half"
    if problem:
        raise InputError(scene.name, problem, remedy)
