"""Photos of HDR truth: exposure, sensor noise, camera response, quantisation."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..errors import InputError
from ..scene import Scene, View, codes_of

# Mertens et al. 2007, "Exposure Fusion": a value's well-exposedness is a Gaussian around one half.
_WELL_EXPOSED_CENTRE, _WELL_EXPOSED_SIGMA = 0.5, 0.2
# Enough samples for a ladder to a hundredth of a stop, whatever the number and size of the views.
_MOST_SAMPLES = 200_000
_STEPS_PER_STOP = 16


class Curve(Protocol):
    """What is needed of a camera response (model.response.Response has it), on NumPy arrays."""

    @property
    def clips(self) -> bool: ...

    @property
    def clip_exposure(self) -> float: ...

    @property
    def white(self) -> float: ...

    def encode(self, exposure: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class SensorNoise:
    """Shot noise and read noise of a linear sensor.

    full_well: electrons at saturation, that is at the response's clip_exposure; for a curve that only approaches its
        peak, at the exposure that is stored as the brightest 8-bit code (Response.white). At least 1.
    read_noise: standard deviation in electrons, at least 0.
    """

    full_well: float = 20_000.0
    read_noise: float = 5.0

    def __post_init__(self):
        if not 1.0 <= self.full_well < 1e12:
            raise InputError("sensor noise", f"full well of {self.full_well:g} electrons", "give 1 to 1e12")
        if not 0.0 <= self.read_noise < 1e9:
            raise InputError("sensor noise", f"read noise of {self.read_noise:g} electrons", "give 0 or more")


def expose(
    scene: Scene,
    response: Curve,
    exposure_time: float | Sequence[float],
    *,
    noise: SensorNoise | None = None,
    bits: int = 8,
    seed: int = 0,
) -> Scene:
    """The scene as photographed: each image becomes response.encode(hdr * exposure_time), rounded to `bits` bits.

    scene: every view has truth (View.hdr), which is kept.
    exposure_time: seconds, positive; one for all views or one for each.
    noise: applied to the linear exposure, before the response; None for none. Photons and read-out are drawn for each
        view from (seed, its name), so a view's photo does not depend on which others there are.
    bits: of a stored value, 1 to 16.

    Points keep their places. Each takes its new colour from the training view whose old photo showed it most nearly in
    its old colour, since that view is the likeliest to see it unoccluded; one outside of all training views keeps its
    own.

    Raises InputError for a view without truth or an impossible time, ValueError for impossible bits or counts.
    """
    times = np.broadcast_to(np.asarray(exposure_time, np.float64), len(scene.views))
    if not (np.isfinite(times).all() and (times > 0).all()):
        raise InputError(scene.name, f"exposure time {times.min():g} s is not positive and finite", "give seconds")
    if not 1 <= bits <= 16:
        raise ValueError(f"{bits} bits are not 1 to 16")
    views = tuple(
        replace(view, codes=_photo(scene, view, response, time, noise, bits, seed), exposure_time=float(time))
        for view, time in zip(scene.views, times, strict=True)
    )
    colors = _recoloured(scene, views)
    return replace(scene, views=views, point_colors=colors, exposure_times_known=True, response=None, chosen_by=None)


def exposure_ladder(scene: Scene, response: Curve, count: int = 5, factor: float = 4.0) -> tuple[float, ...]:
    """`count` exposure times, each `factor` times the last, around a well exposed one.

    The middle time (of an even count, the geometric mean of the two in the middle) is the one that maximises the mean
    well-exposedness exp(-(Z - 0.5)^2 / (2 * 0.2^2)) of the encoded values Z over the truth of the training views
    (Mertens et al. 2007), to a sixteenth of a stop. What the photos show decides, not the brightest lamp.

    Raises InputError where a training view has no truth or all of it is black, ValueError for a count or factor that
    makes no ladder.
    """
    if count < 1 or not 1.0 < factor < 1e6:
        raise ValueError(f"{count} exposures {factor} times apart make no ladder")
    radiance = np.concatenate([_truth(scene, view).ravel() for view in scene.train_views])
    radiance = radiance[:: -(-len(radiance) // _MOST_SAMPLES)].astype(np.float64)
    lit = radiance[radiance > 0]
    if not len(lit):
        raise InputError(scene.name, "the truth of the training views is black", "render it with light")
    low, high = (np.log2(np.percentile(lit, share)) for share in (1, 99))
    # From the brightest parts at black to the darkest at white.
    stops = np.arange(-high - 12, -low + 12, 1 / _STEPS_PER_STOP)
    middle = 2.0 ** max(stops, key=lambda stop: _well_exposedness(response.encode(radiance * 2.0**stop)))
    return tuple(float(middle * factor ** (k - (count - 1) / 2)) for k in range(count))


def _well_exposedness(values: np.ndarray) -> float:
    return float(np.exp(-0.5 * ((values - _WELL_EXPOSED_CENTRE) / _WELL_EXPOSED_SIGMA) ** 2).mean())


def _truth(scene: Scene, view: View) -> np.ndarray:
    if view.hdr is None:
        raise InputError(scene.name, f"view {view.name} has no HDR truth", "only scenes with truth can be exposed")
    return view.hdr


def _photo(
    scene: Scene, view: View, response: Curve, time: float, noise: SensorNoise | None, bits: int, seed: int
) -> np.ndarray:
    exposure = _truth(scene, view).astype(np.float64) * time
    if noise is not None:
        saturation = response.clip_exposure if response.clips else response.white
        rng = np.random.default_rng([seed, zlib.crc32(view.name.encode())])
        exposure = _noisy(exposure, saturation, noise, rng)
    levels = 2**bits - 1
    return codes_of(np.round(np.clip(response.encode(exposure), 0.0, 1.0) * levels) / levels)


def _noisy(exposure: np.ndarray, saturation: float, noise: SensorNoise, rng: np.random.Generator) -> np.ndarray:
    """The exposure that the sensor reports: photons counted up to the full well, then read out."""
    # Ten full wells saturate as surely as more, and Poisson's generator has a largest mean.
    photons = np.minimum(exposure / saturation, 10.0) * noise.full_well
    electrons = np.minimum(rng.poisson(photons), noise.full_well) + rng.normal(0.0, noise.read_noise, exposure.shape)
    return np.clip(electrons, 0.0, noise.full_well) * (saturation / noise.full_well)


def _recoloured(scene: Scene, views: tuple[View, ...]) -> np.ndarray:
    """[P, 3] float32 colours of the points in the new photos."""
    colors = scene.point_colors.astype(np.float32).copy()
    nearest = np.full(len(colors), np.inf)
    for old, new in zip(scene.views, views, strict=True):
        if old.split != "train":
            continue
        camera = old.camera
        x, y, z = camera.world_to_camera[:3, :3] @ scene.points.T + camera.world_to_camera[:3, 3:]
        before = z > 1e-9
        depth = np.where(before, z, 1.0)
        column = np.floor(np.clip(camera.fx * x / depth + camera.cx, -1, camera.width)).astype(int)
        row = np.floor(np.clip(camera.fy * y / depth + camera.cy, -1, camera.height)).astype(int)
        seen = before & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        place = np.flatnonzero(seen)
        difference = np.abs(old.image[row[place], column[place]] - scene.point_colors[place]).sum(axis=1)
        better = difference < nearest[place]
        place, difference = place[better], difference[better]
        nearest[place] = difference
        colors[place] = new.image[row[place], column[place]]
    return colors
