"""Exposure times of photos that do not state their exposure, from the light that they share with photos that do."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ...response import Response
from ...subsets import every_nth, first_names
from ..images.exif import LONGEST, SHORTEST
from ..types import Scene, View
from .matched_points import initial_gains, point_light
from .times import shutter

_FEWEST = 20  # Points that photos have to share
_MOST = 4000  # Points that are compared
_MOST_VIEWS = 64  # Photos that a photo is compared with


def with_estimated_times(scene: Scene, names: Collection[str], response: Response) -> Scene:
    """Give views without an exposure time the one by which they show the light that the other views show.

    Points of the set are compared in the median over points and views, which hidden points do not move. In a set
    without points, and for a view that shares too few, all views are taken to show the same median light. `names` are
    the views of unknown time, which have a guess.
    """
    timed = [view for view in scene.views if view.name not in names]
    views, by_source = [], {}
    for view in scene.views:
        if view.name not in names:
            views.append(view)
            continue
        factor, shared = _factor(view, timed, scene.points, response)
        time = float(np.clip(view.exposure_time * factor, SHORTEST, LONGEST))
        views.append(replace(view, exposure_time=time))
        source = "by points that other photos show too" if shared else "by brightness beside the others"
        source = source if timed else "as a guess, because no photo beside states one"
        by_source.setdefault(source, []).append(views[-1])
    notes = [_note(guessed, source) for source, guessed in by_source.items()]
    return replace(scene, views=tuple(views), notes=(*scene.notes, *notes))


def _note(views: list[View], source: str) -> str:
    """Return the line on views whose times were found in the same way."""
    times = [view.exposure_time for view in views]
    if len(views) == 1:
        return f"{views[0].name} does not state its exposure: {shutter(times[0])} {source}"
    names = first_names([view.name for view in views])
    span = f"{shutter(min(times))} to {shutter(max(times))}".replace(" s to", " to")
    return f"{len(views)} photos do not state their exposure: {span} {source} ({names})"


def _factor(view: View, timed: list[View], points: np.ndarray, response: Response) -> tuple[float, int]:
    """Return the factor on a view's time, and the number of points that it is by; 0 if it is by brightness alone.

    The factor is 1 without a photo to compare with.
    """
    if not timed:
        return 1.0, 0
    timed = every_nth(timed, _MOST_VIEWS)
    points = points[:: max(1, len(points) // _MOST)]
    if len(points):
        visible = np.ones((1 + len(timed), len(points)), bool)
        light = point_light([view, *timed], points, visible, response).logarithms
        shared = np.isfinite(light[0]) & np.isfinite(light[1:]).any(0)  # [P, 3]
        count = int(shared.any(1).sum())
        if count >= _FEWEST:
            others = np.nanmedian(light[1:][:, shared], axis=0)
            return float(np.exp(np.median(light[0][shared] - others))), count
    gains = initial_gains([view, *timed], response).gains
    log_gains = np.log(gains[view.name])
    return float(np.exp(np.median(log_gains) - np.median([np.log(gains[other.name]) for other in timed]))), 0
