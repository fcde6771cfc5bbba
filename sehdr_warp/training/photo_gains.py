"""Whether a camera changed exposure, white balance or falloff unsaid, by the points that its photos share."""

import numpy as np
import torch

from ..response import Response
from ..scene import Scene
from ..scene.photo_gains import PhotoGains, disagreement, fit_gains, rough_stops, start_gains
from .config import Config
from .initialization import make_matcher
from .matching import Matcher
from .plan import Decision

POINTS, FEW_POINTS = 1500, 500  # That are looked for, and for a rough look
LEAST_STOPS, LEAST_CORNERS = 0.15, 0.15
"""Drift, and part of the light that corners lack, from which photos are evened: less is within the fit's own error on
scenes that shine."""
LEAST_DISAGREEMENT = 0.12
"""Stops by which photos differ in the median from which drift is one: matches that slide along a clear sky differ by
less, and gains explain them well."""
LEFT, LEFT_OF_STATED = 0.9, 0.6
"""Part of the photos' disagreement that may be left when they are evened. Over stated times only drift that explains
much is believed: a wrong curve, and what shines, look like some."""
ENOUGH = 0.4  # Part of the pixels that are matched from which photos are alike enough as they are
FEWEST = 100  # Points that a fit needs


def evens(scene: Scene, config: Config, response: Response) -> bool:
    """Whether a training looks for drift: where it may, matches points, and knows light."""
    wanted = config.model.photo_gains
    asked = wanted in ("auto", "always") or (wanted == "unstated" and not scene.exposure_times_known)
    return asked and config.model.initial_density > 0 and not response.learnable


def _decided(gains: PhotoGains | None, stated: bool) -> Decision:
    """What the plan says of it. stated: of photos that state exposure times."""
    if gains is None:
        least = f"{LEAST_STOPS} stops between photos, or {LEAST_CORNERS:.0%} towards the corners"
        reason = "do not contradict the stated times" if stated else f"differ by less than {least}"
        return Decision("photo-gains", {}, "none", f"matched points {reason}")
    found = f"matched points differ by {gains.stops:.2f} stops between photos, {gains.corners:.0%} towards the corners"
    choice = "taken out of the photos, over the times they state" if stated else "taken out of the photos"
    return Decision("photo-gains", {}, choice, found, told=True)


def find_gains(
    scene: Scene, config: Config, response: Response, device: torch.device | str
) -> tuple[PhotoGains | None, Matcher, Decision]:
    """The gains, None where there is no drift to speak of; a matcher of the training views, evened by them; and what
    the plan says of it."""
    stated = scene.exposure_times_known and config.model.photo_gains != "always"
    gains, matcher = _find(scene, response, device, stated)
    return gains, matcher, _decided(gains, stated)


def _find(scene: Scene, response: Response, device, stated: bool) -> tuple[PhotoGains | None, Matcher]:
    """stated: photos state exposure times, which are to be doubted."""
    views, others = scene.train_views, scene.test_views
    cameras = [view.camera for view in others]

    def make(scene: Scene) -> Matcher:
        return make_matcher(scene, response, device)

    def points_of(matcher: Matcher, count: int = POINTS) -> tuple[np.ndarray, np.ndarray]:
        """[P, 3] matched points, and which photos show them: those that they were compared in."""
        found = matcher.match(matcher.pixels(count, np.random.default_rng(0)))
        return found.points.double().cpu().numpy(), matcher.near(cameras)[:, found.views.cpu().numpy()]

    matcher = make(scene)
    if stated and rough_stops(views, *points_of(matcher, FEW_POINTS), response) < LEAST_STOPS:
        return None, matcher
    found, guess = points_of(matcher), start_gains(views, response)
    if not stated and len(found[0]) < ENOUGH * POINTS and guess.stops > LEAST_STOPS:
        found = max(found, points_of(make(guess.even(scene, response))), key=lambda found: len(found[0]))
    if len(found[0]) < FEWEST:
        return None, matcher
    gains = fit_gains(views, others, *found, response)
    if stated and gains.stops_beside(views) < LEAST_STOPS:
        return None, matcher
    if gains.stops < LEAST_STOPS and gains.corners < LEAST_CORNERS:
        return None, matcher
    before, left = (disagreement(views, *found, response, taken) for taken in (None, gains))
    smooth = gains.corners < LEAST_CORNERS and before < LEAST_DISAGREEMENT
    if smooth or left > (LEFT_OF_STATED if stated else LEFT) * before:
        return None, matcher
    matcher = make(gains.even(scene, response))
    gains = fit_gains(views, others, *points_of(matcher), response)
    return gains, make(gains.even(scene, response))
