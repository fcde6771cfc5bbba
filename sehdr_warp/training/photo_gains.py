"""Whether a camera changed exposure, white balance or vignetting unsaid, by the points that its photos share."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ..parallel import prefetch_map
from ..response import Response
from ..runs.config import Config
from ..scene import Scene, View
from ..scene.exposure_compensation import (
    ExposureCompensation,
    disagreement,
    fit_gains,
    initial_gains,
    remaining_vignetting,
    rough_gains,
)
from .initialization import make_matcher
from .matching import Matcher, at_matching_size
from .plan import Decision

MOST_AT_ONCE = 8  # Photos that are made small side by side
POINTS, FEW_POINTS = 1500, 500  # That are looked for, and for a rough look
LEAST_STOPS, LEAST_WHITE_BALANCE, LEAST_CORNERS = 0.15, 0.1, 0.15
"""Drift of exposure, drift of white balance alone, and part of the light that corners lack, from which photos are
evened: less is within the fit's own error on scenes that shine."""
LEAST_DISAGREEMENT = 0.12
"""Stops by which photos differ in the median from which drift is one: matches that slide along a clear sky differ by
less, and gains explain them well."""
LEFT, LEFT_OF_VIGNETTING = 0.9, 0.85
"""Part of the photos' disagreement that may be left when they are evened."""
LEAST_BESIDE = 0.05  # Stops of drift, of what follows neither stated times nor places, from which times are put right
LEFT_OF_OTHERS, LEFT_OF_WHITE_BALANCE = 0.95, 0.75
"""The same of what gains that half of the points tell leave of how photos disagree at the other half: in exposure over
stated times, beside what follows them or where cameras are, and in white balance, by colors. EXIF rounds times and
sensitivities, and cameras tone each photo by itself; what shines, and a wrong curve, explain nothing at other points.
Ground that is brighter from one side explains much, by gains that grow along a flight: harmonics hold it."""
ENOUGH = 0.4  # Part of the pixels that are matched from which photos are alike enough as they are
FEWEST = 100  # Points that a fit needs


def evens(scene: Scene, config: Config, response: Response) -> bool:
    """Whether a training looks for drift: where it may, matches points, and knows light."""
    wanted = config.model.exposure_compensation
    asked = wanted in ("auto", "always") or (wanted == "unstated" and not scene.exposure_times_known)
    return asked and config.model.initial_density > 0 and not response.learnable


def find_gains(
    scene: Scene, config: Config, response: Response, device: torch.device | str
) -> tuple[ExposureCompensation | None, Matcher, Decision]:
    """The gains, None where there is no drift to speak of; a matcher of the training views, evened by them; and what
    the plan says of it."""
    stated = scene.exposure_times_known and config.model.exposure_compensation != "always"
    views, others = scene.train_views, scene.test_views
    cameras = [view.camera for view in others]

    def make(scene: Scene) -> Matcher:
        return make_matcher(scene, response, device)

    def points_of(matcher: Matcher, count: int = POINTS) -> tuple[np.ndarray, np.ndarray]:
        """[P, 3] matched points, and which photos show them: those that they were compared in."""
        found = matcher.match(matcher.pixels(count, np.random.default_rng(0)))
        return found.points.double().cpu().numpy(), matcher.near(cameras)[:, found.views.cpu().numpy()]

    def none(matcher: Matcher) -> tuple[None, Matcher, Decision]:
        least = f"{LEAST_STOPS} stops between photos, or {LEAST_CORNERS:.0%} towards the corners"
        reason = "do not contradict the stated times" if stated else f"differ by less than {least}"
        return None, matcher, Decision("photo-gains", {}, "none", f"matched points {reason}")

    # Photos are matched small: thousands of large ones would be read, evened and held again and again.
    small = replace(scene, views=tuple(prefetch_map(at_matching_size, views, MOST_AT_ONCE)))
    matcher = make(small)
    if stated:
        few = points_of(matcher, FEW_POINTS)
        rough = rough_gains(views, *few, response)
        falls = rough.corner_loss >= LEAST_CORNERS and remaining_vignetting(views, *few, response, rough) < 1
        if not falls and not _drifts(rough, views):
            return none(matcher)
    found, guess = points_of(matcher), initial_gains(small.views, response)
    if not stated and len(found[0]) < ENOUGH * POINTS and guess.stops > LEAST_STOPS:
        found = max(found, points_of(make(guess.normalize_photos(small, response))), key=lambda found: len(found[0]))
    if len(found[0]) < FEWEST:
        return none(matcher)
    parts = _believed(fit_gains(views, others, *found, response), views, found, response, stated)
    if not any(parts.values()):
        return none(matcher)
    matcher = make(fit_gains(views, others, *found, response).parts(**parts).normalize_photos(small, response))
    gains = fit_gains(views, others, *points_of(matcher), response).parts(**parts)
    return gains, make(gains.normalize_photos(small, response)), _decided(gains, parts, stated)


def _believed(
    gains: ExposureCompensation,
    views: Sequence[View],
    found: tuple[np.ndarray, np.ndarray],
    response: Response,
    stated: bool,
) -> dict[str, bool]:
    """Which parts of gains explain the points that were found: exposure, white balance, vignetting."""
    before, after = (disagreement(views, *found, response, taken) for taken in (None, gains.parts(vignetting=False)))
    told = before >= LEAST_DISAGREEMENT and after <= LEFT * before
    exposure = white_balance = not stated and gains.stops >= LEAST_STOPS and told
    if not exposure and (gains.white_balance >= LEAST_WHITE_BALANCE or (stated and _drifts(gains, views))):
        drift, colors = _left_of_others(views, found, response)
        exposure = stated and gains.unexplained_stops(views) >= LEAST_BESIDE and drift <= LEFT_OF_OTHERS
        white_balance = (exposure or gains.white_balance >= LEAST_WHITE_BALANCE) and colors <= LEFT_OF_WHITE_BALANCE
    vignetting = gains.corner_loss >= LEAST_CORNERS
    vignetting = vignetting and remaining_vignetting(views, *found, response, gains) <= LEFT_OF_VIGNETTING
    return {"exposure": exposure, "white_balance": white_balance, "vignetting": vignetting}


def _drifts(gains: ExposureCompensation, views: Sequence[View]) -> bool:
    """Whether gains are large enough to be asked about, beside what follows the stated times or the places."""
    return gains.unexplained_stops(views) >= LEAST_BESIDE or gains.white_balance >= LEAST_WHITE_BALANCE


def _left_of_others(
    views: Sequence[View], found: tuple[np.ndarray, np.ndarray], response: Response
) -> tuple[float, float]:
    """Parts of the disagreement at half of the points that gains of the other half leave: what of their exposure
    follows neither the stated times nor the places, and their white balance by colors."""
    points, seen = found[0], found[1][: len(views)]
    halves, left = (slice(0, None, 2), slice(1, None, 2)), []
    for this, other in (halves, halves[::-1]):
        drift = fit_gains(views, (), points[this], seen[:, this], response).parts(vignetting=False)
        rest = views, points[other], seen[:, other], response
        pairs = [disagreement(*rest, taken) for taken in (drift, drift.explained_part(views))]
        pairs += [disagreement(*rest, taken, colors=True) for taken in (drift.parts(exposure=False), None)]
        left.append([pairs[k] / pairs[k + 1] if pairs[k + 1] else 1.0 for k in (0, 2)])
    drift, colors = np.mean(left, 0)
    return float(drift), float(colors)


def _decided(gains: ExposureCompensation, parts: dict[str, bool], stated: bool) -> Decision:
    """What the plan says of them."""
    figures = []
    if parts["exposure"]:
        figures.append(f"{gains.stops:.2f} stops between photos")
    if parts["white_balance"] and gains.white_balance >= LEAST_WHITE_BALANCE:
        figures.append(f"{gains.white_balance:.2f} stops of white balance between photos")
    if parts["vignetting"]:
        figures.append(f"{gains.corner_loss:.0%} towards the corners")
    over = ", over the times they state" if parts["exposure"] else ", exposures stay as stated"
    choice = f"taken out of the photos{over if stated else ''}"
    return Decision("photo-gains", {}, choice, f"matched points differ by {', '.join(figures)}", told=True)
