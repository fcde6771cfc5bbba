"""Exposure compensation: exposure, white balance and vignetting that a camera changed without stating it."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...parallel import prefetch_map
from ...response import Response
from ..images.exif import exif_lens
from ..photo_storage import PhotoKeeper
from ..types import Scene, View, codes_of, encoded_values

FAINT, BRIGHT = 10 / 255, 245 / 255  # Encoded values below are noise, above they may be clipped; neither is used
TIGHT = 1.0, 0.5, 0.25, 0.1, 0.05, 0.05
"""Scale of the Cauchy weights in log light, by round of the fit: hidden or shiny points lose their weight."""
ROUNDS = 4  # Rounds of the rough fit
NEGLIGIBLE = 0.01  # Relative difference of light below which a photo stays as it is
NO_VIGNETTING = 0.0, 0.0
LENS = 0.05  # Relative difference of focal length below which photos share a lens: structure from motion refines each
FLAT = 0.1  # Axes along which camera positions spread by less than this part of the largest spread are not used
FEWEST_OF_LENS = 3  # Photos that a lens needs for a vignetting of its own
REACH = 0.7
"""Distance from the centre, in half diagonals, that a twentieth of a lens's points must exceed for a vignetting. On
captures with a vignetting of 35 and 54 %, points up to 0.65 give 37 to 57 %, up to 0.7 33 to 42 and 54 to 56 %."""
BAND_ROWS, AT_ONCE = 16, 8  # Rows of a photo, and photos, that are normalized at one time
_log = logging.getLogger("sehdr_warp.scene")


@dataclass(frozen=True)
class ExposureCompensation:
    """Changes that a camera made to each photo beyond its stated exposure.

    Attributes:
        gains: by photo, the factor on its light in each channel (red, green, blue) beyond the stated exposure; their
            geometric mean over the training photos is 1.
        vignetting: by photo, (a, b), the same for all photos of one camera and lens. At r half diagonals from the
            centre the light is multiplied by exp(-(a r^2 + b r^4)). Photos without an entry have no vignetting.
    """

    gains: dict[str, tuple[float, float, float]]
    vignetting: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def stops(self) -> float:
        """Standard deviation of the photos' gains in stops, in the channel that varies most."""
        return float(np.log2(list(self.gains.values())).std(0).max()) if self.gains else 0.0

    def explained_part(self, views: Sequence[View]) -> "ExposureCompensation":
        """Return these gains with only the part of their exposure that other causes explain.

        A gain that is linear in the logarithm of the stated time comes from a wrong response, one that is linear in the
        camera's position from surfaces that are brighter from one side.
        """
        values = np.log([self.gains[view.name] for view in views])
        causes = np.column_stack([np.log([view.exposure_time for view in views]), _positions(views)])
        causes -= causes.mean(0)
        fitted = causes @ np.linalg.lstsq(causes, values[:, 1], rcond=1e-3)[0]
        return _from_logarithms(
            [view.name for view in views], values + (fitted - values[:, 1])[:, None], self.vignetting
        )

    def unexplained_stops(self, views: Sequence[View]) -> float:
        """Return the deviation of exposure in stops that neither stated times nor camera positions explain."""
        totals, explained = (
            np.log2([gains.gains[view.name][1] for view in views]) for gains in (self, self.explained_part(views))
        )
        return float((totals - explained).std())

    @property
    def white_balance(self) -> float:
        """Standard deviation of the photos' white balance in stops, in the channel that varies most."""
        return self.parts(exposure=False).stops

    @property
    def corner_loss(self) -> float:
        """Share of the light that the corners lose, for the lens that loses most."""
        return 1 - float(np.exp(-max(map(sum, self.vignetting.values()), default=0.0)))

    def parts(
        self, *, exposure: bool = True, white_balance: bool = True, vignetting: bool = True
    ) -> "ExposureCompensation":
        """Return these gains reduced to some of their parts.

        Args:
            exposure: keep the exposure, which is green's gain, because cameras balance white by red and blue.
            white_balance: keep the gains of red and blue relative to green.
            vignetting: keep the vignetting.
        """
        values = np.log(list(self.gains.values())).reshape(-1, 3)
        shared = values[:, 1:2]
        logarithms = exposure * shared + white_balance * (values - shared)
        return _from_logarithms(list(self.gains), logarithms, self.vignetting if vignetting else {})

    def normalize_photos(self, scene: Scene, response: Response) -> Scene:
        """Return the scene as if its camera had changed nothing between photos.

        A photo's largest gain becomes part of its exposure time; the other gains and the vignetting are divided out of
        its codes, which then have 16 bits. Clipped codes stay clipped.
        """
        if scene.photos_normalized:
            return scene
        # Codes of 16 bits take up to twice the memory of the photos.
        keeper = PhotoKeeper("auto", len(scene.views), sum(view.codes.size // 3 for view in scene.views))
        normalized = prefetch_map(lambda view: self._view(view, response), scene.views, AT_ONCE)
        views = tuple(keeper.store(view) for view in normalized)
        if keeper.note:
            _log.info("%s", keeper.note)
        return replace(scene, views=views, photos_normalized=True)

    def to_dict(self) -> dict:
        """Return plain values for JSON, which from_dict reads."""
        return {"gains": self.gains, "falloff": self.vignetting}

    @staticmethod
    def from_dict(values: dict) -> "ExposureCompensation":
        """Return the compensation that to_dict described."""
        return ExposureCompensation(values["gains"], values["falloff"])

    def light(self, view: View, rows: slice = slice(None)) -> np.ndarray:
        """Return the factor [rows, W, 3] on the light of a photo at each of its pixels."""
        row, column = np.ogrid[: view.codes.shape[0], : view.codes.shape[1]]
        radius = _radius(view, row[rows], column)[..., None]
        return np.exp(-_power(radius, *self.vignetting.get(view.name, NO_VIGNETTING))) * self.gains.get(
            view.name, (1.0, 1.0, 1.0)
        )

    def _view(self, view: View, response: Response) -> View:
        gain = np.array(self.gains.get(view.name, (1.0, 1.0, 1.0)))
        largest, vignetted = float(gain.max()), view.name in self.vignetting
        time = view.exposure_time * largest
        # In bands, because the light of a large photo takes eight times the memory of its codes.
        bands = [slice(row, row + BAND_ROWS) for row in range(0, len(view.codes), BAND_ROWS)]
        least = min((self.light(view, rows) / largest).min() for rows in (bands if vignetted else bands[:1]))
        if least > 1 - NEGLIGIBLE:
            return replace(view, exposure_time=time)
        codes, table = np.empty(view.codes.shape, np.uint16), response.decode(np.arange(view.levels + 1) / view.levels)

        def divide(light: np.ndarray, factor: np.ndarray) -> np.ndarray:
            return codes_of(response.encode(light / np.maximum(factor / largest, 0.05)), 16)

        if vignetted:
            for rows in bands:
                codes[rows] = divide(table[view.codes[rows]], self.light(view, rows))
        else:  # Each code becomes the same code everywhere in the photo.
            for channel, tables in enumerate(divide(np.repeat(table[:, None], 3, 1), gain).T):
                codes[..., channel] = tables[view.codes[..., channel]]
        codes[view.codes == view.levels] = 65535
        return replace(view, exposure_time=time, codes=codes)


def _positions(views: Sequence[View]) -> np.ndarray:
    """Return camera positions [V, up to 3] of spread 1, along the axes in which they clearly differ."""
    positions = np.array([view.camera.position for view in views])
    axes, spread, _ = np.linalg.svd(positions - positions.mean(0), full_matrices=False)
    return axes[:, spread > FLAT * max(spread[0], 1e-9)]


def initial_gains(views: Sequence[View], response: Response) -> ExposureCompensation:
    """Return gains by the photos' median light alone, which also differs with what the photos show."""
    medians = []
    for view in views:
        encoded = encoded_values(view.codes[::4, ::4]).reshape(-1, 3)
        usable = encoded[((encoded > FAINT) & (encoded < BRIGHT)).all(1)]
        light = response.decode(np.median(usable if len(usable) else encoded, 0)) / view.exposure_time
        medians.append(np.log(np.maximum(light, 1e-6)))
    return _from_logarithms([view.name for view in views], np.array(medians) - np.mean(medians, 0))


def rough_gains(
    views: Sequence[View], points: np.ndarray, visible: np.ndarray, response: Response
) -> ExposureCompensation:
    """Estimate what fit_gains() fits, in a small part of its time.

    Alternates means over photos and over points, with one quadratic vignetting for each lens. Outliers keep their
    weight.
    """
    light, radius = point_light(views, points, visible, response)
    valid, lenses = np.isfinite(light), _measured_lenses(views, light, radius)
    light, square = np.where(valid, light, 0.0), radius[..., None] ** 2
    gains, slopes = np.zeros((len(views), 1, 3)), np.zeros(lenses.max() + 2)  # The last is for photos of no group
    squares = [(lenses == lens)[:, None, None] * square for lens in range(lenses.max() + 1)]
    centered_squares = [(each - _mean(each * valid, valid, 0)) * valid for each in squares]
    for _ in range(ROUNDS):
        for lens, centered in enumerate(centered_squares):
            rest = light - gains + slopes[lenses][:, None, None] * square
            rest -= _mean(rest * valid, valid, 0)
            slopes[lens] -= float((rest * centered).sum() / max((centered**2).sum(), 1e-9))
        rest = light + slopes[lenses][:, None, None] * square
        gains = _mean((rest - _mean((rest - gains) * valid, valid, 0)) * valid, valid, 1)
    names = [view.name for view in views]
    vignetting = {name: (max(float(slopes[lens]), 0.0), 0.0) for name, lens in zip(names, lenses, strict=True)}
    return _from_logarithms(names, gains[:, 0], vignetting)


def _mean(values: np.ndarray, valid: np.ndarray, axis: int) -> np.ndarray:
    return values.sum(axis, keepdims=True) / np.maximum(valid.sum(axis, keepdims=True), 1)


def disagreement(
    views: Sequence[View],
    points: np.ndarray,
    visible: np.ndarray,
    response: Response,
    gains: ExposureCompensation | None = None,
    *,
    colors: bool = False,
) -> float:
    """Return the median difference in stops of photos from the median of all photos that show a point.

    Args:
        views: the photos.
        points: [P, 3] places in the world.
        visible: [V, P] bool, which photos show a point.
        response: the camera's.
        gains: divided out first.
        colors: compare white balance alone, which differs less if points do not match exactly.
    """
    light, radius = point_light(views, points, visible, response)
    light -= _logarithms(gains, views, radius) if gains is not None else 0.0
    if colors:
        light -= light.mean(2, keepdims=True)
    light = light[:, np.isfinite(light).any(0)]
    return float(np.nanmedian(np.abs(light - np.nanmedian(light, 0))) / np.log(2)) if light.size else 0.0


def remaining_vignetting(
    views: Sequence[View], points: np.ndarray, visible: np.ndarray, response: Response, gains: ExposureCompensation
) -> float:
    """Return the fraction of the median cross-photo disagreement that remains after the vignetting correction.

    Differences are weighted by how much the vignetting predicts, because few points lie near the centre of one photo
    and near the corner of another. Arguments are those of disagreement().
    """
    light, radius = point_light(views, points, visible, response)
    predicted = np.where(np.isfinite(light), -_powers(gains, views, radius)[..., None], np.nan)
    light -= _logarithms(gains.parts(vignetting=False), views, radius)
    several = np.isfinite(light).sum(0) > 1
    light, predicted = light[:, several], predicted[:, several]
    before, after, predicted = (v - np.nanmedian(v, 0) for v in (light, light - predicted, predicted))
    valid = np.isfinite(predicted)
    before, after = (_weighted_median(np.abs(v[valid]), np.abs(predicted[valid])) for v in (before, after))
    return after / before if before > 0 else 1.0


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)]) if len(values) else 0.0


def _logarithms(gains: ExposureCompensation, views: Sequence[View], radius: np.ndarray) -> np.ndarray:
    """Return the logarithm [V, P, 3] of the factor that gains and vignetting put on light."""
    return np.log([gains.gains[view.name] for view in views])[:, None] - _powers(gains, views, radius)[..., None]


def _powers(gains: ExposureCompensation, views: Sequence[View], radius: np.ndarray) -> np.ndarray:
    """Return the exponents [V, P] of each photo's vignetting."""
    a, b = np.array([gains.vignetting.get(view.name, NO_VIGNETTING) for view in views]).T[..., None]
    return _power(radius, a, b)


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


def unmeasured_reach(
    views: Sequence[View], points: np.ndarray, visible: np.ndarray, response: Response
) -> tuple[int, float]:
    """Return how many photos have a lens whose points do not reach far enough to measure its vignetting, and how far.

    The reach is the 95th percentile of the points' distances from the centre, in half diagonals; 0 without such photos.
    Arguments are those of disagreement().
    """
    reach = _reach(lens_groups(views), *point_light(views, points, visible, response))
    short = reach[reach < REACH]
    return len(short), float(short.max(initial=0.0))


def _measured_lenses(views: Sequence[View], light: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return lens_groups(), but -1 for lenses whose points do not reach far enough to extrapolate to the corners."""
    lenses = lens_groups(views)
    return np.where(_reach(lenses, light, radius) < REACH, -1, lenses)


def _reach(lenses: np.ndarray, light: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the reach [V] of the points of each photo's lens, see unmeasured_reach(); 1 without points or a lens."""
    reach, has_light = np.ones(len(lenses)), np.asarray(np.isfinite(light).any(2))
    for lens in set(lenses) - {-1}:
        distances = radius[lenses == lens][has_light[lenses == lens]]
        if distances.size:
            reach[lenses == lens] = np.percentile(distances, 95)
    return reach


def fit_gains(
    views: Sequence[View], others: Sequence[View], points: np.ndarray, visible: np.ndarray, response: Response
) -> ExposureCompensation:
    """Fit the gains of photos and the vignetting of lenses by which photos agree on the light of surface points.

    Least squares of logarithms, reweighted with Cauchy's weights of decreasing scale. A lens whose points do not come
    near the corners, see REACH, has no vignetting.

    Args:
        views: photos that take part.
        others: photos that do not, and get the median of their differences.
        points: [P, 3] places of surfaces in the world.
        visible: [V + others, P] bool, which photos show a point; occlusion is not known otherwise.
        response: the camera's.
    """
    from scipy import sparse
    from scipy.sparse.linalg import lsmr

    every, view_count, point_count = [*views, *others], len(views), len(points)
    names = [view.name for view in every]
    light, radius = point_light(every, points, visible, response)
    lenses = _measured_lenses(every, light, radius)
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
    return _from_logarithms(names, np.array(gains) - mean, vignetting)


def _possible(pair: np.ndarray) -> tuple[float, float]:
    """Return a vignetting, or none if its light would grow towards the corners."""
    a, b = map(float, pair)
    return (a, b) if _power(np.linspace(0, 1, 20), a, b).min() > -NEGLIGIBLE else NO_VIGNETTING


def _from_logarithms(
    names: Sequence[str], logarithms: np.ndarray, vignetting: Mapping[str, tuple[float, float]] | None = None
) -> ExposureCompensation:
    gains = np.exp(logarithms).tolist()
    darkened = {name: pair for name, pair in (vignetting or {}).items() if pair != NO_VIGNETTING}
    return ExposureCompensation({name: tuple(gain) for name, gain in zip(names, gains, strict=True)}, darkened)


def _power(r: np.ndarray, a: float | np.ndarray, b: float | np.ndarray) -> np.ndarray:
    return a * r**2 + b * r**4


def _radius(view: View, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return the distance of pixels from the centre of the photo in half diagonals."""
    height, width = view.codes.shape[:2]
    return np.hypot(column + 0.5 - width / 2, row + 0.5 - height / 2) / np.hypot(width / 2, height / 2)


def point_light(views: Sequence[View], points, visible, response) -> tuple[np.ndarray, np.ndarray]:
    """Return _light() of all photos: [V, P, 3], NaN if unknown or not visible, and radii [V, P]."""
    light, radius = zip(*(_light(view, points, response) for view in views), strict=True)
    return np.where(visible[: len(views), :, None], np.stack(light), np.nan), np.stack(radius)


def _light(view: View, points: np.ndarray, response: Response) -> tuple[np.ndarray, np.ndarray]:
    """Return the log radiance [P, 3] of the pixels that points fall on, NaN if unknown, and their radii [P]."""
    row, column, _, inside = view.camera.project(points)
    place = np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)
    if view.mask is not None:
        inside &= view.mask[place] > 0.5
    encoded = encoded_values(view.codes[place])
    usable = inside[:, None] & (encoded > FAINT) & (encoded < BRIGHT)
    light = np.log(np.maximum(response.decode(encoded), 1e-9) / view.exposure_time)
    return np.where(usable, light, np.nan), _radius(view, *place)
