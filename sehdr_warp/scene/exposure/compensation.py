"""Exposure compensation: exposure, white balance and vignetting that a camera changed without stating it."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...parallel import prefetch_map
from ...response import Response
from ..photo_storage import PhotoKeeper
from ..types import Scene, View, codes_of

NEGLIGIBLE = 0.01  # Relative difference of light below which a photo stays as it is
NO_VIGNETTING = 0.0, 0.0
FLAT = 0.1  # Axes along which camera positions spread by less than this part of the largest spread are not used
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

    @staticmethod
    def from_logarithms(
        names: Sequence[str], logarithms: np.ndarray, vignetting: Mapping[str, tuple[float, float]] | None = None
    ) -> "ExposureCompensation":
        """Return the compensation of photos by their names, the logarithms [V, 3] of their gains, and vignetting."""
        gains = np.exp(logarithms).tolist()
        darkened = {name: pair for name, pair in (vignetting or {}).items() if pair != NO_VIGNETTING}
        return ExposureCompensation({name: tuple(gain) for name, gain in zip(names, gains, strict=True)}, darkened)

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
        return ExposureCompensation.from_logarithms(
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
        return ExposureCompensation.from_logarithms(list(self.gains), logarithms, self.vignetting if vignetting else {})

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
        radius = image_radius(view, row[rows], column)[..., None]
        return np.exp(-vignetting_power(radius, *self.vignetting.get(view.name, NO_VIGNETTING))) * self.gains.get(
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


def vignetting_power(r: np.ndarray, a: float | np.ndarray, b: float | np.ndarray) -> np.ndarray:
    """Return the exponents by which a vignetting (a, b) darkens r half diagonals from the centre."""
    return a * r**2 + b * r**4


def image_radius(view: View, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return the distance of pixels from the centre of the photo in half diagonals."""
    height, width = view.codes.shape[:2]
    return np.hypot(column + 0.5 - width / 2, row + 0.5 - height / 2) / np.hypot(width / 2, height / 2)
