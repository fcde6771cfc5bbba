"""Evidence of photos for the lights of a scene: what they show of Gaussians, and how sure that makes a light."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..scene import Camera

SURFACE = 2.0  # Times white, below which light that darker photos measure, with its deviation, is that of a surface
MEASURED_STOPS = 0.25  # Deviation of light that a darker photo shows unclipped: surfaces are lit within 7 to 19 % then
EXPECTED_CLIPPED = 0.9  # Of the share that clips if the scene is right, from which the darkest photos' white is certain
SPREAD = 3**0.5  # Deviations from the mean of an even distribution to its end
DARKEST_CLIPPED = 0.5  # Of the share that the darkest photos show, which clips there too


class ReceivedLight(NamedTuple):
    """Light that a camera or a point receives of each Gaussian."""

    pixels: Tensor  # [N] sums of its blending weights over the pixels
    angles: Tensor  # [N] solid angle that nothing hides, steradians
    light: Tensor  # [N, 3] radiance times this angle


@dataclass(frozen=True, eq=False)
class Photos:
    """Sample of V photos, and what they receive of the N Gaussians of a scene."""

    cameras: list[Camera]  # Of the photos, in the scene's coordinates
    received: list[ReceivedLight]  # By each photo
    white: float  # Radiance that lights exceed
    unclipped: Tensor  # [V, N] whether each is of at least twice that white and shows most of a Gaussian unclipped
    measured: Tensor  # [N] whether enough of them do
    focal: float  # Typical focal length, pixels
    whites: np.ndarray  # [V] radiance that each photo clips at
    pixels: Tensor  # [N] sums over the photos
    radiance: Tensor  # [N, 3] mean towards the photos
    brightness: Tensor  # [N, 2] means of the brightness of the pixels that show each, and of its square


@dataclass(frozen=True, eq=False)
class Candidates:
    """K Gaussians that can belong to lights, and what V photos receive of them.

    Attributes:
        index: [K] int64, in the scene, on its device.
        positions: [K, 3], scene coordinates.
        axes: [K, 3, 3] rows: principal axes, as long as their standard deviations, scene units.
        weights: [K] radiance times pixels.
        brightness: [K] radiance of the brightest channel.
        too_bright: [K] whether a photo of the usual exposure clips it.
        measured: [K] whether photos of half that exposure or less do not clip it.
        unclipped: [V, K] whether each photo is one of those.
        clipped: [K] in [0, 1], which share of its values clips.
        stops: [K] deviation of log2 radiance, of its whole light; None if it was not measured.
        doubt: [K] stops of its confidence.
        angles: [V, K] solid angles that photos see.
        light: [V, K, 3] radiance times these.
        pixel_brightness: [K, 2] means of the brightness of the pixels that show it, and of its square.
    """

    index: Tensor
    positions: np.ndarray
    axes: np.ndarray
    weights: np.ndarray
    brightness: np.ndarray
    too_bright: np.ndarray
    measured: np.ndarray
    unclipped: np.ndarray
    clipped: np.ndarray
    stops: np.ndarray | None
    doubt: np.ndarray
    angles: np.ndarray
    light: np.ndarray
    pixel_brightness: np.ndarray

    @property
    def longest(self) -> np.ndarray:
        """The longest of the axes [K, 3]."""
        return self.axes[np.arange(len(self.axes)), np.linalg.norm(self.axes, axis=2).argmax(1)]

    def rows(self, rows: np.ndarray) -> "Candidates":
        """Return some of the Gaussians."""
        index = self.index[torch.from_numpy(rows).to(self.index.device)]
        parts: dict[str, Any] = {"index": index}
        parts |= {name: getattr(self, name)[:, rows] for name in ("unclipped", "angles", "light")}
        others = {name: value for name, value in vars(self).items() if name not in parts}
        parts |= {name: None if value is None else value[rows] for name, value in others.items()}
        return Candidates(**parts)


def brightest_in_photos(group: Candidates) -> float:
    """Return the brightness that photos show of a light where it is brightest: a faint Gaussian is brighter than that.

    Of a blurred point of light, as much light is in dim as in bright pixels, up to SPREAD deviations above the mean.
    """
    mean, square = np.average(group.pixel_brightness, axis=0, weights=group.weights)
    return float(mean + SPREAD * np.sqrt(max(square - mean**2, 0.0)))


def is_surface(group: Candidates, white: float) -> bool:
    """Return whether photos that do not clip most of a group measure it as no brighter than a white surface.

    The mean is weighted by light, so that a small lamp counts more than a wall around it.
    """
    light, angles = _towards(group, group.unclipped)
    if group.stops is None or not light.any() or group.weights @ group.measured <= group.weights.sum() / 2:
        return False
    brightness = float(np.average(light / np.maximum(angles, 1e-30), weights=light))
    misfit = float(np.average(_misfit(group), weights=light))
    return brightness * 2 ** max(misfit, MEASURED_STOPS) < SURFACE * white


def _towards(group: Candidates, photos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return light [K] of the brightest channel and solid angles [K] of measured Gaussians towards photos [V, K]."""
    counts = photos & group.measured
    return (group.light.max(2) * counts).sum(0), (group.angles * counts).sum(0)


def _misfit(group: Candidates) -> np.ndarray:
    """Return the stops [K] by which the scene contradicts unclipped values."""
    return np.maximum(group.doubt - group.stops, 0) / np.maximum(1 - group.clipped, 1e-6)


def deviation_of_light(group: Candidates) -> tuple[float | None, float]:
    """Return the mean deviation of a light and the share of it that is measured, as Light has them."""
    if group.stops is None:
        return None, 0.0
    stops = group.stops / np.maximum(group.clipped, 1e-6)
    # The scene may contradict the photos that measure it, or have other light towards those that clip it.
    light, angles = np.array([_towards(group, photos) for photos in (group.unclipped, ~group.unclipped)]).sum(2).T
    apart = abs(float(np.diff(np.log2(light / angles))[0])) if light.all() else 0.0
    limits = np.maximum(_misfit(group), max(MEASURED_STOPS, apart))
    deviations = np.where(group.measured, np.minimum(stops, limits), stops)
    weights = group.weights * np.maximum(group.clipped, 1e-6)
    mean = float(np.average(deviations, weights=weights))
    measured = float(np.average(deviations * group.measured, weights=weights))
    return mean, measured / mean if mean else 0.0


def certain_radiance(group: Candidates, photos: Photos) -> np.ndarray:
    """Return the mean radiance [3] up to the white of the darkest photos that clip each Gaussian of a light."""
    angles = group.angles.sum(0)
    radiance = group.light.sum(0) / np.maximum(angles, 1e-30)[:, None]
    clips = (group.angles > 0)[..., None] & (radiance > photos.whites[:, None, None])
    expected = (clips.mean(2) * group.angles).sum(0) / np.maximum(angles, 1e-30)
    darkest = np.where(clips, photos.whites[:, None, None], 0.0).max(0)
    dark = (clips & (photos.whites[:, None, None] >= darkest)) * group.angles[..., None]
    of_darkest = dark.sum(0) / np.maximum(angles, 1e-30)[:, None]
    # If fewer values clip, the scene is brighter than some photos, which may be the darkest ones alone, and in one
    # channel alone, which counts a third.
    missing = np.minimum((1 - EXPECTED_CLIPPED) * expected[:, None], (1 - DARKEST_CLIPPED) * of_darkest / 3)
    sure = np.where((expected - group.clipped)[:, None] <= missing, darkest, 0.0)
    bound = np.minimum(np.maximum(sure, photos.white), radiance)
    return np.average(bound, axis=0, weights=np.maximum(angles, 1e-30))
