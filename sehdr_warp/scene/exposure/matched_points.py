"""Points that several photos show, and the exposure compensation by which the photos agree on their light."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...response import Response
from ..images.exif import exif_lens
from ..types import View, encoded_values
from .compensation import NEGLIGIBLE, NO_VIGNETTING, ExposureCompensation, image_radius, vignetting_power

FAINT, BRIGHT = 10 / 255, 245 / 255  # Encoded values below are noise, above they may be clipped; neither is used
TIGHT = 1.0, 0.5, 0.25, 0.1, 0.05, 0.05
"""Scale of the Cauchy weights in log light, by round of the fit: hidden or shiny points lose their weight."""
ROUNDS = 4  # Rounds of the rough fit
LENS = 0.05  # Relative difference of focal length below which photos share a lens: structure from motion refines each
FEWEST_OF_LENS = 3  # Photos that a lens needs for a vignetting of its own
REACH = 0.7
"""Distance from the centre, in half diagonals, that a twentieth of a lens's points must exceed for a vignetting. On
captures with a vignetting of 35 and 54 %, points up to 0.65 give 37 to 57 %, up to 0.7 33 to 42 and 54 to 56 %."""


class PointLight(NamedTuple):
    """Light of P points in V photos."""

    logarithms: np.ndarray  # [V, P, 3] log radiance, NaN if unknown or not visible
    radius: np.ndarray  # [V, P] distances from the centres of the photos, half diagonals


@dataclass(frozen=True)
class MatchedPoints:
    """Points that several photos show, and these photos."""

    views: Sequence[View]  # Training views
    others: Sequence[View]  # Views that no gain is fitted to: they get the median of their differences
    points: np.ndarray  # [P, 3] places of surfaces in the world
    visible: np.ndarray  # [V + others, P] bool: which views show which points; occlusion is not known otherwise
    response: Response

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    @cached_property
    def light(self) -> PointLight:
        """The light of the points in the training views."""
        return point_light(self.views, self.points, self.visible, self.response)

    def every_other(self, first: int) -> "MatchedPoints":
        """Return half of the points, from number `first` on, without the other views."""
        return replace(self, others=(), points=self.points[first::2], visible=self.visible[:, first::2])

    def rough_fit(self) -> ExposureCompensation:
        """Estimate what fit() fits, in a small part of its time.

        Alternates means over photos and over points, with one quadratic vignetting for each lens. Outliers keep their
        weight.
        """
        light, radius = self.light
        valid, lenses = np.isfinite(light), _measured_lenses(self.views, self.light)
        light, square = np.where(valid, light, 0.0), radius[..., None] ** 2
        gains, slopes = np.zeros((len(light), 1, 3)), np.zeros(lenses.max() + 2)  # The last is for photos of no group
        squares = [(lenses == lens)[:, None, None] * square for lens in range(lenses.max() + 1)]
        centered_squares = [(each - _mean(each * valid, valid, 0)) * valid for each in squares]
        for _ in range(ROUNDS):
            for lens, centered in enumerate(centered_squares):
                rest = light - gains + slopes[lenses][:, None, None] * square
                rest -= _mean(rest * valid, valid, 0)
                slopes[lens] -= float((rest * centered).sum() / max((centered**2).sum(), 1e-9))
            rest = light + slopes[lenses][:, None, None] * square
            gains = _mean((rest - _mean((rest - gains) * valid, valid, 0)) * valid, valid, 1)
        names = [view.name for view in self.views]
        vignetting = {name: (max(float(slopes[lens]), 0.0), 0.0) for name, lens in zip(names, lenses, strict=True)}
        return ExposureCompensation.from_logarithms(names, gains[:, 0], vignetting)

    def fit(self) -> ExposureCompensation:
        """Fit the gains of photos and the vignetting of lenses by which photos agree on the light of the points.

        Least squares of logarithms, reweighted with Cauchy's weights of decreasing scale. A lens whose points do not
        come near the corners, see REACH, has no vignetting.
        """
        from scipy import sparse
        from scipy.sparse.linalg import lsmr

        every, view_count, point_count = [*self.views, *self.others], len(self.views), len(self)
        names = [view.name for view in every]
        light, radius = point_light(every, self.points, self.visible, self.response) if self.others else self.light
        lenses = _measured_lenses(every, PointLight(light, radius))
        view, point, channel = np.nonzero(np.isfinite(light[:view_count]))
        values, lens = light[view, point, channel], lenses[view]
        r = np.where(lens >= 0, radius[view, point], 0.0)
        one, rows = np.ones(len(values)), np.arange(len(values))
        # Unknowns: the light of each point and the gain of each photo, by channel, then a and b of each lens.
        first_lens = 3 * (point_count + view_count)
        a = first_lens + 2 * lens.clip(0)
        columns = np.concatenate([3 * point + channel, 3 * (point_count + view) + channel, a, a + 1])
        factors, shape = np.concatenate([one, one, -(r**2), -(r**4)]), (len(rows), first_lens + 2 * (lenses.max() + 2))
        system = sparse.csr_matrix((factors, (np.tile(rows, 4), columns)), shape=shape)
        solution: np.ndarray = np.zeros(shape[1])
        for width in TIGHT:
            residual = (values - system @ solution) / width if solution.any() else np.zeros_like(values)
            weight = 1 / (1 + residual**2)
            solution = lsmr(sparse.diags(weight) @ system, weight * values, damp=1e-3, x0=solution, maxiter=80)[0]
        pairs = [*map(_possible, solution[first_lens:].reshape(-1, 2)[: lenses.max() + 1]), NO_VIGNETTING]
        vignetting = {name: pairs[lens] for name, lens in zip(names, lenses, strict=True)}
        powers = _powers(ExposureCompensation({}, vignetting), every, radius)
        surfaces = solution[: 3 * point_count].reshape(point_count, 3)
        gains = list(solution[3 * point_count : first_lens].reshape(view_count, 3))
        mean = np.mean(gains, 0)
        for index in range(view_count, len(names)):
            differences = light[index] - surfaces + powers[index][:, None]
            has_values = np.isfinite(differences).sum(0).min() > 0
            gains.append(np.nanmedian(differences, 0) if has_values else mean)
        return ExposureCompensation.from_logarithms(names, np.array(gains) - mean, vignetting)

    def disagreement(self, gains: ExposureCompensation | None = None, *, colors: bool = False) -> float:
        """Return the median difference in stops of photos from the median of all photos that show a point.

        Args:
            gains: divided out first.
            colors: compare white balance alone, which differs less if points do not match exactly.
        """
        light = self.light.logarithms if gains is None else self._corrected(gains)
        if colors:
            light = light - light.mean(2, keepdims=True)
        light = light[:, np.isfinite(light).any(0)]
        return float(np.nanmedian(np.abs(light - np.nanmedian(light, 0))) / np.log(2)) if light.size else 0.0

    def remaining_vignetting(self, gains: ExposureCompensation) -> float:
        """Return the fraction of the median cross-photo disagreement that remains after the vignetting correction.

        Differences are weighted by how much the vignetting predicts, because few points lie near the centre of one
        photo and near the corner of another.
        """
        light, powers = self._corrected(gains.parts(vignetting=False)), _powers(gains, self.views, self.light.radius)
        predicted = np.where(np.isfinite(light), -powers[..., None], np.nan)
        several = np.isfinite(light).sum(0) > 1
        light, predicted = light[:, several], predicted[:, several]
        before, after, predicted = (v - np.nanmedian(v, 0) for v in (light, light - predicted, predicted))
        valid = np.isfinite(predicted)
        before, after = (_weighted_median(np.abs(v[valid]), np.abs(predicted[valid])) for v in (before, after))
        return after / before if before > 0 else 1.0

    def unmeasured_reach(self) -> tuple[int, float]:
        """Return how many photos have a lens whose points are too far from the corners for a vignetting, and how far.

        The reach is the 95th percentile of the points' distances from the centre, in half diagonals; 0 without such
        photos.
        """
        reach = _reach(lens_groups(self.views), self.light)
        short = reach[reach < REACH]
        return len(short), float(short.max(initial=0.0))

    def _corrected(self, gains: ExposureCompensation) -> np.ndarray:
        """Return the logarithms [V, P, 3] of the light without the factor that gains and vignetting put on it."""
        powers = _powers(gains, self.views, self.light.radius)
        light = self.light.logarithms.copy()
        light -= np.log([gains.gains[view.name] for view in self.views])[:, None] - powers[..., None]
        return light


def point_light(views: Sequence[View], points: np.ndarray, visible: np.ndarray, response: Response) -> PointLight:
    """Return the light of points [P, 3] in photos; `visible` [V or more, P] says which photos show which points."""
    light, radius = zip(*(_light(view, points, response) for view in views), strict=True)
    return PointLight(np.where(visible[: len(views), :, None], np.stack(light), np.nan), np.stack(radius))


def _light(view: View, points: np.ndarray, response: Response) -> tuple[np.ndarray, np.ndarray]:
    """Return the log radiance [P, 3] of the pixels that points fall on, NaN if unknown, and their radii [P]."""
    row, column, _, inside = view.camera.project(points)
    place = np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)
    if view.mask is not None:
        inside &= view.mask[place] > 0.5
    encoded = encoded_values(view.codes[place])
    usable = inside[:, None] & (encoded > FAINT) & (encoded < BRIGHT)
    light = np.log(np.maximum(response.decode(encoded), 1e-9) / view.exposure_time)
    return np.where(usable, light, np.nan), image_radius(view, *place)


def initial_gains(views: Sequence[View], response: Response) -> ExposureCompensation:
    """Return gains by the photos' median light alone, which also differs with what the photos show."""
    medians = []
    for view in views:
        encoded = encoded_values(view.codes[::4, ::4]).reshape(-1, 3)
        usable = encoded[((encoded > FAINT) & (encoded < BRIGHT)).all(1)]
        light = response.decode(np.median(usable if len(usable) else encoded, 0)) / view.exposure_time
        medians.append(np.log(np.maximum(light, 1e-6)))
    return ExposureCompensation.from_logarithms([view.name for view in views], np.array(medians) - np.mean(medians, 0))


def lens_groups(views: Sequence[View]) -> np.ndarray:
    """Return the number [V] of the camera, lens, focal length and aperture of each photo, by EXIF and field of view.

    Groups of fewer than FEWEST_OF_LENS photos are joined into one, which is -1 if it has fewer too.
    """
    fields = np.log([view.camera.fx / np.hypot(view.camera.width, view.camera.height) for view in views])
    order, steps = np.argsort(fields, kind="stable"), np.zeros(len(views), int)
    steps[order] = np.cumsum(np.diff(fields[order], prepend=fields[order[0]]) > LENS)
    keys = [(*exif_lens(view.source), int(step)) for view, step in zip(views, steps, strict=True)]
    for _ in range(2):
        counts = Counter(keys)
        keys = [key if counts[key] >= FEWEST_OF_LENS else () for key in keys]
    lenses = list(dict.fromkeys(key for key in keys if counts[key] >= FEWEST_OF_LENS))
    return np.array([lenses.index(key) if key in lenses else -1 for key in keys])


def _measured_lenses(views: Sequence[View], light: PointLight) -> np.ndarray:
    """Return lens_groups(), but -1 for lenses whose points do not reach far enough to extrapolate to the corners."""
    lenses = lens_groups(views)
    return np.where(_reach(lenses, light) < REACH, -1, lenses)


def _reach(lenses: np.ndarray, light: PointLight) -> np.ndarray:
    """Return the reach [V] of the points of each lens, see unmeasured_reach(); 1 without points or lens."""
    reach, has_light = np.ones(len(lenses)), np.asarray(np.isfinite(light.logarithms).any(2))
    for lens in set(lenses) - {-1}:
        distances = light.radius[lenses == lens][has_light[lenses == lens]]
        if distances.size:
            reach[lenses == lens] = np.percentile(distances, 95)
    return reach


def _powers(gains: ExposureCompensation, views: Sequence[View], radius: np.ndarray) -> np.ndarray:
    """Return the exponents [V, P] of each photo's vignetting."""
    a, b = np.array([gains.vignetting.get(view.name, NO_VIGNETTING) for view in views]).T[..., None]
    return vignetting_power(radius, a, b)


def _possible(pair: np.ndarray) -> tuple[float, float]:
    """Return a vignetting, or none if its light would grow towards the corners."""
    a, b = map(float, pair)
    return (a, b) if vignetting_power(np.linspace(0, 1, 20), a, b).min() > -NEGLIGIBLE else NO_VIGNETTING


def _mean(values: np.ndarray, valid: np.ndarray, axis: int) -> np.ndarray:
    return values.sum(axis, keepdims=True) / np.maximum(valid.sum(axis, keepdims=True), 1)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)]) if len(values) else 0.0
