"""Whether a camera changed exposure, white balance or falloff unsaid, by the points that its photos share."""

import numpy as np
import torch

from ..response import Response
from ..scene import Scene
from ..scene.photo_gains import PhotoGains, fit_gains, start_gains
from .config import Config
from .initialization import make_matcher
from .matching import Matcher
from .plan import Decision

POINTS = 1500
LEAST_STOPS, LEAST_CORNERS = 0.15, 0.15
"""Drift, and part of the light that corners lack, from which photos are evened: less is within the fit's own error on
scenes that shine."""
ENOUGH = 0.4  # Part of the pixels that are matched from which photos are alike enough as they are
FEWEST = 100  # Points that a fit needs


def evens(scene: Scene, config: Config, response: Response) -> bool:
    """Whether a training looks for drift: where it may, matches points, and knows light."""
    wanted = {"unstated": not scene.exposure_times_known, "always": True, "never": False}[config.model.photo_gains]
    return wanted and config.model.initial_density > 0 and not response.learnable


def decided(gains: PhotoGains | None) -> Decision:
    """What the plan says of it."""
    least = f"{LEAST_STOPS} stops between photos, or {LEAST_CORNERS:.0%} towards the corners"
    if gains is None:
        return Decision("photo-gains", {}, "none", f"matched points differ by less than {least}")
    found = f"matched points differ by {gains.stops:.2f} stops between photos, {gains.corners:.0%} towards the corners"
    return Decision("photo-gains", {}, "taken out of the photos", found, told=True)


def find_gains(scene: Scene, response: Response, device: torch.device | str) -> tuple[PhotoGains | None, Matcher]:
    """The gains, None where there is no drift to speak of; and a matcher of the training views, evened by them."""

    def make(scene: Scene) -> Matcher:
        return make_matcher(scene, response, device)

    matcher = make(scene)
    points = _points(matcher)
    guess = start_gains(scene.train_views, response)
    if len(points) < ENOUGH * POINTS and guess.stops > LEAST_STOPS:
        evened = _points(make(guess.even(scene, response)))
        points = evened if len(evened) > len(points) else points
    if len(points) < FEWEST:
        return None, matcher
    gains = fit_gains(scene.train_views, scene.test_views, points, response)
    if gains.stops < LEAST_STOPS and gains.corners < LEAST_CORNERS:
        return None, matcher
    matcher = make(gains.even(scene, response))
    gains = fit_gains(scene.train_views, scene.test_views, _points(matcher), response)
    return gains, make(gains.even(scene, response))


def _points(matcher: Matcher) -> np.ndarray:
    found = matcher.match(matcher.pixels(POINTS, np.random.default_rng(0)))
    return found.points.double().cpu().numpy()
