"""Decide whether a camera changed exposure, white balance or vignetting between photos without stating it.

The evidence is the light of points that several photos show: the gains that explain its differences are estimated by
scene.exposure.matched_points, and only the components that clearly explain them are corrected.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from ..response import Response
from ..runs.config import Config
from ..scene import Scene, View
from ..scene.exposure.compensation import ExposureCompensation
from ..scene.exposure.matched_points import MatchedPoints, initial_gains
from ..subsets import counted, first_names
from .initialization import make_matcher
from .matching import Matcher, at_matching_size
from .plan import COMPENSATION, DRIFT, UNMEASURED, Decision

POINTS, ROUGH_POINTS = 1500, 500  # Pixels to match for the fit, and for a rough one
MIN_STOPS, MIN_WHITE_BALANCE, MIN_CORNER_LOSS = 0.15, 0.1, 0.15
"""Smallest corrections: stops of exposure, stops of white balance, fraction of light missing in the corners. Smaller
ones are within the error of the fit on scenes with shiny surfaces."""
MIN_DISAGREEMENT = 0.12
"""Median disagreement between photos, stops, that can be drift. Wrong matches along a clear sky stay below it, although
gains explain them well."""
MAX_REMAINING, MAX_REMAINING_VIGNETTING = 0.9, 0.85
"""Largest fraction of the disagreement that may remain after a correction of exposure, or of vignetting."""
MIN_UNEXPLAINED_STOPS = 0.05
"""Smallest drift in stops, not explained by stated times or camera positions, for which stated times are corrected."""
MAX_REMAINING_CROSS, MAX_REMAINING_WHITE_BALANCE = 0.95, 0.75
"""The same as MAX_REMAINING in cross validation: gains are fitted to half of the points and evaluated on the others.
Used for corrections of stated times, beyond what stated times and positions explain, and of white balance; and for
vignetting, with MAX_REMAINING_VIGNETTING. EXIF rounds
times and sensitivities, and cameras tone each photo by itself; shiny surfaces and a wrong response explain nothing at
other points. Ground that is brighter from one side is explained by gains that grow along a flight, but there the
harmonics represent it."""
CHANGED_LIGHT = 0.5  # Stops between a photo and what it states, relative to the median photo, from which it is named
ENOUGH_MATCHES = 0.4  # Fraction of pixels that must match for photos to count as similar in brightness
MIN_POINTS = 100  # Fewest points for a fit


class Components(NamedTuple):
    """Components of a compensation to apply; arguments of ExposureCompensation.parts()."""

    exposure: bool
    white_balance: bool
    vignetting: bool


class CompensationEstimate(NamedTuple):
    """Result of estimate_compensation()."""

    compensation: ExposureCompensation | None  # Correction of the photos; None if there is no drift
    decision: Decision  # Line of the plan
    matcher: Matcher | None  # Matcher of the training photos as they are, for use if there is no drift; else None


@dataclass(frozen=True)
class SharedDecisions:
    """Decisions that several trainings of one set of photos share, so that their Gaussians render as one scene."""

    base_time: float  # Exposure time dt_1 that colors refer to, seconds
    compensation: ExposureCompensation | None  # Correction of all photos; None if there is no drift
    antialiased: bool = False  # model.antialiased

    def compensation_of(self, views: Sequence[View]) -> ExposureCompensation | None:
        """Return the entries of some views of the compensation."""
        if self.compensation is None:
            return None
        names, whole = {view.name for view in views}, self.compensation
        gains = {name: gain for name, gain in whole.gains.items() if name in names}
        vignetting = {name: terms for name, terms in whole.vignetting.items() if name in names}
        return ExposureCompensation(gains, vignetting)


def estimates_compensation(scene: Scene, config: Config, response: Response) -> bool:
    """Return whether a training estimates a compensation.

    It does if that is allowed, if it matches points between pinhole photos, and if the response is known.
    """
    option = config.model.exposure_compensation
    allowed = option in ("auto", "always") or (option == "unstated" and not scene.exposure_times_known)
    pinholes = all(view.camera.is_pinhole for view in scene.train_views)
    return allowed and pinholes and config.model.initial_density > 0 and not response.learnable


def estimate_compensation(
    scene: Scene, config: Config, response: Response, device: torch.device | str, depth: float | None = None
) -> CompensationEstimate:
    """Match points between the photos of a scene and estimate the compensation that explains their differences.

    `depth` is that of make_matcher().
    """
    times_known = scene.exposure_times_known and config.model.exposure_compensation != "always"
    views, others = scene.train_views, scene.test_views

    def match(matcher: Matcher, count: int = POINTS) -> MatchedPoints:
        matches = matcher.match(matcher.pixels(count, np.random.default_rng(0)))
        visible = matcher.near([view.camera for view in others])[:, matches.views.cpu().numpy()]
        return MatchedPoints(views, others, matches.points.double().cpu().numpy(), visible, response)

    def no_drift(matcher: Matcher, matched: MatchedPoints, gains=None) -> CompensationEstimate:
        return CompensationEstimate(None, _no_drift_decision(matched, gains, times_known), matcher)

    # Resized once, because the photos are read and corrected several times.
    small = replace(scene, views=at_matching_size(views))
    matcher = make_matcher(small, response, device, depth)
    if times_known and not _may_drift(rough := match(matcher, ROUGH_POINTS)):
        return no_drift(matcher, rough)
    matched, guess = match(matcher), initial_gains(small.views, response)
    if not times_known and len(matched) < ENOUGH_MATCHES * POINTS and guess.stops > MIN_STOPS:
        alike = match(make_matcher(guess.normalize_photos(small, response), response, device, depth))
        matched = max(matched, alike, key=len)
    if len(matched) < MIN_POINTS:
        return no_drift(matcher, matched)
    compensation = matched.fit()
    components = _explanatory_components(compensation, matched, times_known)
    if not any(components):
        return no_drift(matcher, matched, None if times_known else compensation)
    # Match again in photos that are already similar: more points are found.
    parts = compensation.parts(**components._asdict())
    matcher = make_matcher(parts.normalize_photos(small, response), response, device, depth)
    matched = match(matcher)
    compensation = matched.fit().parts(**components._asdict())
    return CompensationEstimate(compensation, _decision(compensation, components, matched, times_known), None)


def _may_drift(matched: MatchedPoints) -> bool:
    """Return whether photos with stated times may drift, by a rough fit to few points."""
    rough = matched.rough_fit()
    if _exceeds_stated(rough, matched.views):
        return True
    return rough.corner_loss >= MIN_CORNER_LOSS and matched.remaining_vignetting(rough) < 1


def _explanatory_components(
    compensation: ExposureCompensation, matched: MatchedPoints, times_known: bool
) -> Components:
    """Return the components of a compensation to apply: large ones that explain how photos differ at shared points.

    Exposure that photos state is corrected only by what explains other points than those of its fit, too.
    """
    views, before = matched.views, matched.disagreement()
    after = matched.disagreement(compensation.parts(vignetting=False))
    explains = before >= MIN_DISAGREEMENT and after <= MAX_REMAINING * before
    exposure = white_balance = not times_known and compensation.stops >= MIN_STOPS and explains
    validate = cache(lambda: _cross_validate(matched))
    if not exposure and (
        compensation.white_balance >= MIN_WHITE_BALANCE or (times_known and _exceeds_stated(compensation, views))
    ):
        exposure = (
            times_known
            and compensation.unexplained_stops(views) >= MIN_UNEXPLAINED_STOPS
            and validate().exposure <= MAX_REMAINING_CROSS
        )
        white_balance = (
            exposure or compensation.white_balance >= MIN_WHITE_BALANCE
        ) and validate().white_balance <= MAX_REMAINING_WHITE_BALANCE
    vignetting = compensation.corner_loss >= MIN_CORNER_LOSS and validate().vignetting <= MAX_REMAINING_VIGNETTING
    return Components(exposure, white_balance, vignetting)


def _exceeds_stated(compensation: ExposureCompensation, views: Sequence[View]) -> bool:
    """Return whether gains, beyond what stated times and positions explain, are large enough to be considered."""
    return (
        compensation.unexplained_stops(views) >= MIN_UNEXPLAINED_STOPS
        or compensation.white_balance >= MIN_WHITE_BALANCE
    )


class Remaining(NamedTuple):
    """Fractions of the disagreement at half of the points that gains of the other half leave."""

    exposure: float  # Relative to gains that follow stated times and positions
    white_balance: float  # By colors
    vignetting: float  # See remaining_vignetting()


def _cross_validate(matched: MatchedPoints) -> Remaining:
    """Return what gains that are fitted to half of the points leave at the other half; the mean of both ways."""
    halves, remaining = [matched.every_other(first) for first in (0, 1)], []
    for fitted, rest in (halves, halves[::-1]):
        fit = fitted.fit()
        drift = fit.parts(vignetting=False)
        exposure = rest.disagreement(drift), rest.disagreement(drift.explained_part(matched.views))
        colors = rest.disagreement(drift.parts(exposure=False), colors=True), rest.disagreement(colors=True)
        vignetting = rest.remaining_vignetting(fit)
        remaining.append([*(after / before if before else 1.0 for after, before in (exposure, colors)), vignetting])
    return Remaining(*np.mean(remaining, 0).tolist())


def _reach_note(matched: MatchedPoints) -> str:
    """Return the end of the plan's line about photos whose vignetting is left out; empty if there are none."""
    count, reach = matched.unmeasured_reach()
    if not count:
        return ""
    return f"; vignetting of {count} photos is left out: their points reach {reach:.0%} of the way to the corners"


def _changed_light(compensation: ExposureCompensation, views: Sequence[View]) -> str:
    """Return a part of the plan's line that names photos far from what they state; empty if there are none.

    Points do not tell a camera's gain from a change of the light.
    """
    stops = np.log2([compensation.gains[view.name][1] for view in views])
    off = stops - np.median(stops)
    changed = [i for i in np.argsort(-np.abs(off), kind="stable") if abs(off[i]) >= CHANGED_LIGHT]
    if not changed:
        return ""
    names = first_names([f"{views[i].name} {off[i]:+.1f}" for i in changed])
    return (
        f"; {counted(len(changed), 'photo is', 'photos are')} brighter or darker than stated (stops: {names}); "
        "clouds may have passed, or the camera brightens photos by itself"
    )


def _decision(
    compensation: ExposureCompensation, components: Components, matched: MatchedPoints, times_known: bool
) -> Decision:
    """Return the line of the plan for gains that are corrected."""
    figures = []
    if components.exposure:
        figures.append(f"{compensation.stops:.2f} stops between photos")
    if components.white_balance and compensation.white_balance >= MIN_WHITE_BALANCE:
        figures.append(f"{compensation.white_balance:.2f} stops of white balance between photos")
    if components.vignetting:
        figures.append(f"{compensation.corner_loss:.0%} towards the corners")
    detail = ", in addition to stated exposure times" if components.exposure else "; stated exposure times are kept"
    choice = f"corrected in the photos{detail if times_known else ''}"
    changed = _changed_light(compensation, matched.views) if times_known else ""
    reason = f"matched points differ by {', '.join(figures)}{changed}{_reach_note(matched)}"
    return Decision({}, choice, reason, COMPENSATION, always_log=True)


def _no_drift_decision(matched: MatchedPoints, gains: ExposureCompensation | None, times_known: bool) -> Decision:
    """Return the line of the plan for photos that stay as they are, with the gains that do not explain them, if any."""
    choice, least = "none", f"{MIN_STOPS} stops between photos, or {MIN_CORNER_LOSS:.0%} towards the corners"
    reason = "do not contradict the stated times" if times_known else f"differ by less than {least}"
    if gains is not None and (gains.stops >= MIN_STOPS or gains.corner_loss >= MIN_CORNER_LOSS):
        figures = f"{gains.stops:.2f} stops between photos and {gains.corner_loss:.0%} towards the corners"
        reason = f"differ by {figures}, and correcting that does not make them alike"
    reason = f"matched points {reason}{_reach_note(matched)}"
    if len(matched) < MIN_POINTS:
        choice, reason = UNMEASURED, f"{len(matched)} points match between the photos, too few to measure it"
    elif gains is not None and np.ptp(np.log2(list(gains.gains.values()))[:, 1]) >= DRIFT:
        choice = UNMEASURED
    return Decision({}, choice, reason, COMPENSATION)
