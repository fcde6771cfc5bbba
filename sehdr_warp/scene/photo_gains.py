"""What a camera changed between photos and no file states: exposure, white balance, and falloff towards the corners."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..parallel import made_ahead
from ..response import Response
from .exposure import exif_lens
from .photo_file import PhotoKeeper
from .types import Scene, View, codes_of, encoded_values

FAINT, BRIGHT = 10 / 255, 245 / 255  # Encoded values within tell light; beyond, noise or less than all of it
TIGHT = 1.0, 0.5, 0.25, 0.1, 0.05, 0.05
"""Differences of log light that count half, round by round: what is hidden, or shines, is to count nothing."""
ROUNDS = 4  # Of the rough look
NEGLIGIBLE = 0.01  # Of light: what differs by less is left as it is
NONE = 0.0, 0.0  # Falloff
LENS = 0.05  # Focal lengths that differ by less, as a part, are one lens: structure from motion finds each anew
FLAT = 0.1  # Of the largest spread of cameras: along an axis where they differ by less, places tell nothing
FEWEST_OF_LENS = 3  # Photos that tell a falloff
BAND_ROWS, AT_ONCE = 16, 8  # Rows of a photo, and photos, that are evened at one time
_log = logging.getLogger("sehdr_warp.scene")


@dataclass(frozen=True)
class PhotoGains:
    """gains: by photo, what its light was multiplied by in each channel, beyond the exposure that is stated; of
    geometric mean 1 over the training photos. falloff: by photo, (a, b) >= 0 in all, alike for one camera and lens;
    light at r half diagonals from the middle is exp(-(a r^2 + b r^4)) of what it would be there. Photos that are absent
    have none."""

    gains: dict[str, tuple[float, float, float]]
    falloff: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def stops(self) -> float:
        """Deviation of the photos' gains, of the channel that varies most."""
        return float(np.log2(list(self.gains.values())).std(0).max()) if self.gains else 0.0

    def following(self, views: Sequence[View]) -> "PhotoGains":
        """These gains of photos with only that part of their exposure that follows the times they state, that a wrong
        curve makes, or the places of their cameras: surfaces that are brighter from one side look like it."""
        values = np.log([self.gains[view.name] for view in views])
        told = np.column_stack([np.log([view.exposure_time for view in views]), _places(views)])
        told -= told.mean(0)
        along = told @ np.linalg.lstsq(told, values[:, 1], rcond=1e-3)[0]
        return _of([view.name for view in views], values + (along - values[:, 1])[:, None], self.falloff)

    def stops_beside(self, views: Sequence[View]) -> float:
        """Deviation of that part of the photos' exposure which follows neither the times they state nor places."""
        ours, along = (
            np.log2([gains.gains[view.name][1] for view in views]) for gains in (self, self.following(views))
        )
        return float((ours - along).std())

    @property
    def tint(self) -> float:
        """Deviation of the photos' white balance, in stops, of the channel that varies most."""
        return self.parts(exposure=False).stops

    @property
    def corners(self) -> float:
        """Part of the light that the corners lack, of the lens that lacks most."""
        return 1 - float(np.exp(-max(map(sum, self.falloff.values()), default=0.0)))

    def parts(self, *, exposure: bool = True, tint: bool = True, falloff: bool = True) -> "PhotoGains":
        """These gains without what is not asked for: exposure, which is green's, since cameras balance white by red
        and blue; white balance; falloff."""
        values = np.log(list(self.gains.values())).reshape(-1, 3)
        shared = values[:, 1:2]
        kept = self.falloff if falloff else {}
        return _of(list(self.gains), exposure * shared + tint * (values - shared), kept)

    def even(self, scene: Scene, response: Response) -> Scene:
        """The scene as if its camera had changed nothing: a photo's largest gain is part of its exposure time, the rest
        and the falloff are taken from its codes, which have 16 bits then. White stays `at least white`."""
        if scene.evened:
            return scene
        # 16 bits are twice what the photos took.
        keeper = PhotoKeeper("auto", len(scene.views), sum(view.codes.size // 3 for view in scene.views))
        evened = made_ahead(lambda view: self._view(view, response), scene.views, AT_ONCE)
        views = tuple(keeper.kept(view) for view in evened)
        if keeper.note:
            _log.info("%s", keeper.note)
        return replace(scene, views=views, evened=True)

    def light(self, view: View, rows: slice = slice(None)) -> np.ndarray:
        """[rows, W, 3] what the light of a photo was multiplied by."""
        row, column = np.ogrid[: view.codes.shape[0], : view.codes.shape[1]]
        radius = _radius(view, row[rows], column)[..., None]
        return np.exp(-_power(radius, *self.falloff.get(view.name, NONE))) * self.gains.get(view.name, (1.0, 1.0, 1.0))

    def _view(self, view: View, response: Response) -> View:
        gain = np.array(self.gains.get(view.name, (1.0, 1.0, 1.0)))
        largest, falls = float(gain.max()), view.name in self.falloff
        time = view.exposure_time * largest
        # In bands: of a large photo the light alone is eight times its codes.
        bands = [slice(row, row + BAND_ROWS) for row in range(0, len(view.codes), BAND_ROWS)]
        least = min((self.light(view, rows) / largest).min() for rows in (bands if falls else bands[:1]))
        if least > 1 - NEGLIGIBLE:
            return replace(view, exposure_time=time)
        codes, table = np.empty(view.codes.shape, np.uint16), response.decode(np.arange(view.levels + 1) / view.levels)

        def evened(light: np.ndarray, by: np.ndarray) -> np.ndarray:
            return codes_of(response.encode(light / np.maximum(by / largest, 0.05)), 16)

        if falls:
            for rows in bands:
                codes[rows] = evened(table[view.codes[rows]], self.light(view, rows))
        else:  # What becomes of a code is alike all over the photo.
            for channel, tables in enumerate(evened(np.repeat(table[:, None], 3, 1), gain).T):
                codes[..., channel] = tables[view.codes[..., channel]]
        codes[view.codes == view.levels] = 65535
        return replace(view, exposure_time=time, codes=codes)


def _places(views: Sequence[View]) -> np.ndarray:
    """[V, up to 3] where cameras are, of spread 1 at most, along axes that they plainly differ along."""
    places = np.array([view.camera.position for view in views])
    axes, spread, _ = np.linalg.svd(places - places.mean(0), full_matrices=False)
    return axes[:, spread > FLAT * max(spread[0], 1e-9)]


def start_gains(views: Sequence[View], response: Response) -> PhotoGains:
    """Gains by the photos' medians alone: as far off as what they show differs."""
    found = []
    for view in views:
        encoded = encoded_values(view.codes[::4, ::4]).reshape(-1, 3)
        told = encoded[((encoded > FAINT) & (encoded < BRIGHT)).all(1)]
        light = response.decode(np.median(told if len(told) else encoded, 0)) / view.exposure_time
        found.append(np.log(np.maximum(light, 1e-6)))
    return _of([view.name for view in views], np.array(found) - np.mean(found, 0))


def rough_gains(views: Sequence[View], points: np.ndarray, seen: np.ndarray, response: Response) -> PhotoGains:
    """About what fit_gains() finds, in a small part of its time: means in turn over photos and over points, and for
    each lens a line over the radius, in which what shines counts as all else does."""
    light, radius = _lights(views, points, seen, response)
    told, of = np.isfinite(light), lenses_of(views)
    light, square = np.where(told, light, 0.0), radius[..., None] ** 2
    gains, slopes = np.zeros((len(views), 1, 3)), np.zeros(of.max() + 2)  # The last: of no lens
    mine = [(of == lens)[:, None, None] * square for lens in range(of.max() + 1)]
    beside = [(own - _mean(own * told, told, 0)) * told for own in mine]
    for _ in range(ROUNDS):
        for lens, own in enumerate(beside):
            left = light - gains + slopes[of][:, None, None] * square
            left -= _mean(left * told, told, 0)
            slopes[lens] -= float((left * own).sum() / max((own**2).sum(), 1e-9))
        left = light + slopes[of][:, None, None] * square
        gains = _mean((left - _mean((left - gains) * told, told, 0)) * told, told, 1)
    names = [view.name for view in views]
    falloff = {name: (max(float(slopes[lens]), 0.0), 0.0) for name, lens in zip(names, of, strict=True)}
    return _of(names, gains[:, 0], falloff)


def _mean(values: np.ndarray, told: np.ndarray, axis: int) -> np.ndarray:
    return values.sum(axis, keepdims=True) / np.maximum(told.sum(axis, keepdims=True), 1)


def disagreement(
    views: Sequence[View],
    points: np.ndarray,
    seen: np.ndarray,
    response: Response,
    gains: PhotoGains | None = None,
    *,
    colors: bool = False,
) -> float:
    """By how many stops photos differ, in the median, from the median of all that show a point; less their gains.
    colors: in white balance alone, which differs less where points do not quite match."""
    light, radius = _lights(views, points, seen, response)
    light -= _logarithms(gains, views, radius) if gains is not None else 0.0
    if colors:
        light -= light.mean(2, keepdims=True)
    light = light[:, np.isfinite(light).any(0)]
    return float(np.nanmedian(np.abs(light - np.nanmedian(light, 0))) / np.log(2)) if light.size else 0.0


def left_of_falloff(views: Sequence[View], points: np.ndarray, seen: np.ndarray, response: Response, gains: PhotoGains):
    """Part of the disagreement between evened photos and photos with their falloff, in the median over where falloff
    says that they differ, by how much: few points lie far from the middle in one photo and near it in another."""
    light, radius = _lights(views, points, seen, response)
    said = np.where(np.isfinite(light), -_powers(gains, views, radius)[..., None], np.nan)
    light -= _logarithms(gains.parts(falloff=False), views, radius)
    several = np.isfinite(light).sum(0) > 1
    light, said = light[:, several], said[:, several]
    before, left, said = (values - np.nanmedian(values, 0) for values in (light, light - said, said))
    told = np.isfinite(said)
    before, left = (_weighted_median(np.abs(values[told]), np.abs(said[told])) for values in (before, left))
    return left / before if before > 0 else 1.0


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)]) if len(values) else 0.0


def _logarithms(gains: PhotoGains, views: Sequence[View], radius: np.ndarray) -> np.ndarray:
    """[V, P, 3] of the light that gains and falloff leave of all."""
    return np.log([gains.gains[view.name] for view in views])[:, None] - _powers(gains, views, radius)[..., None]


def _powers(gains: PhotoGains, views: Sequence[View], radius: np.ndarray) -> np.ndarray:
    """[V, P] by the falloff of each photo."""
    a, b = np.array([gains.falloff.get(view.name, NONE) for view in views]).T[..., None]
    return _power(radius, a, b)


def lenses_of(views: Sequence[View]) -> np.ndarray:
    """[V] int: which camera, lens, focal length and aperture took each photo, by EXIF and by the field of view. Those
    that took fewer than FEWEST_OF_LENS count as one, and as -1 where that took fewer too."""
    fields = np.log([view.camera.fx / np.hypot(view.camera.width, view.camera.height) for view in views])
    order, steps = np.argsort(fields, kind="stable"), np.zeros(len(views), int)
    steps[order] = np.cumsum(np.diff(fields[order], prepend=fields[order[0]]) > LENS)
    keys = [(*exif_lens(view.source), int(step)) for view, step in zip(views, steps, strict=True)]
    for _ in range(2):
        counts = Counter(keys)
        keys = [key if counts[key] >= FEWEST_OF_LENS else () for key in keys]
    lenses = list(dict.fromkeys(key for key in keys if counts[key] >= FEWEST_OF_LENS))
    return np.array([lenses.index(key) if key in lenses else -1 for key in keys])


def fit_gains(
    views: Sequence[View], others: Sequence[View], points: np.ndarray, seen: np.ndarray, response: Response
) -> PhotoGains:
    """Gains, and falloff of each lens, by which photos show points [P, 3] of surfaces in one light: least squares of
    logarithms, in which what disagrees counts ever less (Cauchy's weights). others: photos that take no part, and get
    their median.
    seen: [V + others, P] bool, which photos show a point: what lies before it is not known otherwise."""
    from scipy import sparse
    from scipy.sparse.linalg import lsmr

    names = [view.name for view in (*views, *others)]
    light, radius = _lights((*views, *others), points, seen, response)
    trained, count, most, of = light[: len(views)], len(points), len(views), lenses_of((*views, *others))
    view, point, channel = np.nonzero(np.isfinite(trained))
    values, lens = trained[view, point, channel], of[view]
    r = np.where(lens >= 0, radius[view, point], 0.0)
    one = np.ones(len(values))
    rows = np.arange(len(values))
    first = 3 * (count + most)
    columns = 3 * point + channel, 3 * (count + view) + channel, first + 2 * lens.clip(0)
    system = sparse.csr_matrix(
        (
            np.concatenate([one, one, -(r**2), -(r**4)]),
            (np.tile(rows, 4), np.concatenate([*columns, columns[2] + 1])),
        ),
        shape=(len(rows), first + 2 * (of.max() + 2)),
    )
    found: np.ndarray = np.zeros(first + 2 * (of.max() + 2))
    for width in TIGHT:
        off = (values - system @ found) / width if found.any() else np.zeros_like(values)
        weight = 1 / (1 + off**2)
        found = lsmr(sparse.diags(weight) @ system, weight * values, damp=1e-3, x0=found, maxiter=80)[0]
    pairs = [*map(_possible, found[first:].reshape(-1, 2)[: of.max() + 1]), NONE]
    falloff = {name: pairs[lens] for name, lens in zip(names, of, strict=True)}
    powers = _powers(PhotoGains({}, falloff), (*views, *others), radius)
    surfaces = found[: 3 * count].reshape(count, 3)
    gains = list(found[3 * count : first].reshape(most, 3))
    mean = np.mean(gains, 0)
    for index in range(most, len(names)):
        differences = light[index] - surfaces + powers[index][:, None]
        told = np.isfinite(differences).sum(0).min() > 0
        gains.append(np.nanmedian(differences, 0) if told else mean)
    return _of(names, np.array(gains) - mean, falloff)


def _possible(pair: np.ndarray) -> tuple[float, float]:
    """A falloff, or none where light would grow towards the corners."""
    a, b = map(float, pair)
    return (a, b) if _power(np.linspace(0, 1, 20), a, b).min() > -NEGLIGIBLE else NONE


def _of(
    names: Sequence[str], logarithms: np.ndarray, falloff: Mapping[str, tuple[float, float]] | None = None
) -> PhotoGains:
    gains = np.exp(logarithms).tolist()
    fallen = {name: pair for name, pair in (falloff or {}).items() if pair != NONE}
    return PhotoGains({name: tuple(gain) for name, gain in zip(names, gains, strict=True)}, fallen)


def _power(r: np.ndarray, a: float | np.ndarray, b: float | np.ndarray) -> np.ndarray:
    return a * r**2 + b * r**4


def _radius(view: View, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Distance of pixels from the middle of the picture, in half diagonals."""
    height, width = view.codes.shape[:2]
    return np.hypot(column + 0.5 - width / 2, row + 0.5 - height / 2) / np.hypot(width / 2, height / 2)


def _lights(views: Sequence[View], points, seen, response) -> tuple[np.ndarray, np.ndarray]:
    """[V, P, 3], nan where unknown or not seen, and [V, P]: _light() of all."""
    light, radius = zip(*(_light(view, points, response) for view in views), strict=True)
    return np.where(seen[: len(views), :, None], np.stack(light), np.nan), np.stack(radius)


def _light(view: View, points: np.ndarray, response: Response) -> tuple[np.ndarray, np.ndarray]:
    """[P, 3] log radiance of the pixels that points fall on, by the stated exposure, nan where they tell none; and
    their radii [P]."""
    camera = view.camera
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = np.where(local[:, 2] > 1e-9, local[:, 2], np.inf)
    column = np.floor(camera.fx * local[:, 0] / depth + camera.cx)
    row = np.floor(camera.fy * local[:, 1] / depth + camera.cy)
    inside = (depth < np.inf) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    place = np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)
    if view.mask is not None:
        inside &= view.mask[place] > 0.5
    encoded = encoded_values(view.codes[place])
    told = inside[:, None] & (encoded > FAINT) & (encoded < BRIGHT)
    light = np.log(np.maximum(response.decode(encoded), 1e-9) / view.exposure_time)
    return np.where(told, light, np.nan), _radius(view, *place)
