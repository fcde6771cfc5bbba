"""Lights of a trained scene: groups of bright Gaussians that the photos clipped, as simple emitting shapes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..scene import Camera
from ..scene.camera_focus import camera_positions, map_center
from ..scene.wide_camera import pixels_of_directions, steradians, typical_focal_length
from ..subsets import every_nth
from .confidence import RESIDUAL_WEIGHT
from .gaussians import rotate
from .light_evidence import (
    Candidates,
    Photos,
    ReceivedLight,
    brightest_in_photos,
    certain_radiance,
    deviation_of_light,
    is_surface,
)
from .light_shapes import LightShape, connected_groups, fit_solid_angles, fitted_shape, solid_angles
from .radiance_field import RadianceField

CLIPPED = 0.3  # Share of the values of photos too bright for a Gaussian that clip, from which it can belong to a light
BRIGHT = 0.7  # Times white, from which a Gaussian can belong to a light, and from which a photo is too bright for it
MOST_CLIPPED = 0.1  # Share of all photos' pixels that may clip at the exposure whose white decides what a light is
LEAST_SEEN = 0.3  # Pixels of blending weight over all views, likewise
LEAST_MEASURED = 0.05  # Pixels likewise over darker photos that do not clip, from which these measure a Gaussian
CORE, CORE_BRIGHT = 0.75, 0.5  # Of a light's share that clips, or brightness, from which Gaussians count for its shape
EXTENT, WHOLE = 2.0, 0.95  # A photo holds a light if this share of its weight lies within, out to so many widths
LEAST_SHARE = 5e-4  # Of the light at the middle of the cameras, if nothing hides the light from there
UNOBSTRUCTED = 0.5  # Of what most views show of a light: those that show less count as obstructed
MOST_LIGHTS, MOST_VIEWS = 64, 24  # MOST_VIEWS of the longest exposures, and of those of half of these or less
LEAST_ROWS, MOST_ROWS = 128, 724  # Of the map of a point's light: in coarse pixels small Gaussians hide nothing


@dataclass(frozen=True, eq=False)
class Light:
    """One light of a scene.

    Attributes:
        shape: its place and size.
        radiance: [3] in the field's colors; with the shape it gives the light that training views show, of those
            from which nothing hides it, and is no brighter than their pixels. If each view cuts the light off at its
            border, it is what reaches the place of the one that shows most of it.
        lower_bound: [3] certain radiance: the white of the darkest photos that clip it, or less where it has less of a
            color.
        deviation: of log2 radiance, stops, of what photos clip; None if that was not measured. Edges and colors that do
            not clip do not count, because all its photos may err alike; where photos of half the exposure or less do
            not clip, it is at most the largest of MEASURED_STOPS, what the scene differs from unclipped values, and
            what it differs between these photos and the others.
        share: of the light that reaches map_center(), with what hides it from there; 0 of what photos walk around.
        members: [K] int64, its Gaussians.
        measured: share of its deviation that is of Gaussians which photos of half the exposure or less show unclipped.
    """

    shape: LightShape
    radiance: np.ndarray
    lower_bound: np.ndarray
    deviation: float | None
    share: float
    members: Tensor
    measured: float = 0.0


def light_name(index: int) -> str:
    """Return the name of the light at an index of find_lights(), as files, tables, reports and the viewer have it."""
    return f"light_{index}"


@torch.no_grad()
def received_light(
    field: RadianceField, position: np.ndarray, focal: float, *, beyond: float = 0.0, degree: int | None = None
) -> ReceivedLight:
    """Return what a point receives of each Gaussian.

    Args:
        field: a trained scene.
        position: [3] of the point, scene coordinates.
        focal: focal length of the photos, pixels.
        beyond: Gaussians nearer than this are left out; scene units.
        degree: of the harmonics; by default all.
    """
    opacities = None
    if beyond:
        place = torch.tensor(field.normalization.points(position), dtype=torch.float32)
        distance = (field.gaussians.means - place.to(field.gaussians.means.device)).norm(dim=1)
        opacities = field.gaussians.opacities() * (distance * field.normalization.unit >= beyond)
    return _received_by(field, _panorama(position, focal), degree, opacities, at_place=True)


@torch.no_grad()
def find_lights(
    field: RadianceField,
    clipped: Tensor,
    views: Sequence[tuple[Camera, float]],
    *,
    degree: int | None = None,
) -> list[Light]:
    """Return the lights of a scene, sorted by their share of light.

    Args:
        field: a trained scene.
        clipped: [N] in [0, 1], which share of the values that show a Gaussian was clipped; on any device.
        views: training cameras in the scene's coordinates, with their exposure times in seconds.
        degree: of the harmonics; by default all.
    """
    if not views:
        return []
    photos = _measure_photos(field, clipped, views, degree)
    candidates = _candidates(field, clipped, photos)
    if not len(candidates.index):
        return []
    cameras = [camera for camera, _ in views]
    middle, center = camera_positions(cameras).mean(0), map_center(cameras)
    reaches_middle = reaches_center = received_light(field, middle, photos.focal, degree=degree).light.mean(1)
    if center.beyond:
        around = {"beyond": center.beyond, "degree": degree}
        reaches_center = received_light(field, center.position, photos.focal, **around).light.mean(1)
    total, of_center = (max(float(light.sum()), 1e-30) for light in (reaches_middle, reaches_center))
    panoramas: dict[int, ReceivedLight] = {}
    lights = []
    for rows in connected_groups(candidates.positions, candidates.longest):
        group = candidates.rows(rows)
        if group.weights @ group.too_bright < CLIPPED * group.weights.sum():
            continue  # Darker photos alone show most of it and do not clip it, as the part of a walk in the sun.
        if is_surface(group, photos.white):
            continue
        # The wall behind a colored tube clips, too, in one channel: its light counts, its place does not.
        clips = group.clipped >= CORE * np.average(group.clipped, weights=group.weights)
        mean = np.average(group.brightness[clips], weights=group.weights[clips])
        core = group.rows(np.flatnonzero(clips | (group.brightness >= CORE_BRIGHT * mean)))
        shape = fitted_shape(core.positions, core.axes, core.weights, middle)
        light_photos = _whole_photos(photos.cameras, group, core, shape)
        if not len(light_photos.photos):
            # Every photo cuts the light off at its border. The one that shows most of it looks beyond that.
            best = int(np.argmax(group.angles.sum(1) * (solid_angles(shape, photos.cameras) > 0)))
            if best not in panoramas:
                panoramas[best] = _received_by(field, _panorama(photos.cameras[best].position, photos.focal), degree)
            angles, light = panoramas[best].angles[core.index], panoramas[best].light[group.index]
            sums = (values.sum(0, keepdim=True).cpu().numpy() for values in (angles, light))
            light_photos = _LightPhotos(np.array([best]), *sums)
        light_photos = light_photos.without_obstructed(solid_angles(shape, photos.cameras))
        if not len(light_photos.photos):
            continue  # A flat light at whose edge all cameras stand.
        places = [photos.cameras[index].position for index in light_photos.photos]
        area = float(fit_solid_angles(shape, light_photos.angles[:, None], places)[0])
        # As large as it looks: the pixels of the photos blur small lights, and Gaussians reach beyond their centers.
        shape = shape.with_area(min(max(area, 1e-4), 1e4))
        # No brighter than pixels, which show faint Gaussians and what is behind them: the same light of a larger area.
        excess = fit_solid_angles(shape, light_photos.light, places).mean() / max(brightest_in_photos(group), 1e-30)
        shape = shape.with_area(min(max(excess, 1.0), 1e4))
        radiance = fit_solid_angles(shape, light_photos.light, places)
        if radiance.mean() * shape.solid_angle(middle) < LEAST_SHARE * total:
            continue
        deviation, measured = deviation_of_light(group)
        share = float(reaches_center[group.index].sum()) / of_center
        bound = np.minimum(certain_radiance(group, photos), radiance)
        lights.append(Light(shape, radiance, bound, deviation, share, group.index, measured))
    return sorted(lights, key=lambda light: -light.share)[:MOST_LIGHTS]


class _LightPhotos(NamedTuple):
    """Light that P photos receive of one light: their indices [P], solid angles [P] and light [P, 3]."""

    photos: np.ndarray
    angles: np.ndarray
    light: np.ndarray

    def without_obstructed(self, whole: np.ndarray) -> "_LightPhotos":
        """Return the photos that show about as much of the light's solid angles [V], `whole`, as most do."""
        expected = whole[self.photos]
        fractions = self.angles / np.maximum(expected, 1e-30)
        clear = (expected > 0) & (fractions >= UNOBSTRUCTED * np.quantile(fractions, 0.9))
        return _LightPhotos(self.photos[clear], self.angles[clear], self.light[clear])


def _measure_photos(
    field: RadianceField, clipped: Tensor, views: Sequence[tuple[Camera, float]], degree: int | None
) -> Photos:
    """Render a sample of the photos, and find the white that lights exceed."""
    times = np.array([time for _, time in views])
    longest = times > times.max() / 2
    parts = [part.nonzero()[0] for part in (longest, ~longest)]
    samples = [every_nth(part, MOST_VIEWS) for part in parts]
    sample = np.concatenate(samples)
    cameras, whites = [views[index][0] for index in sample], field.response.white / times[sample]
    received = [_received_by(field, camera, degree) for camera in cameras]
    pixels = reduce(torch.add, (each.pixels for each in received))
    angles = reduce(torch.add, (each.angles for each in received))
    light = reduce(torch.add, (each.light for each in received))
    radiance = light / angles.clamp_min(1e-20)[:, None]
    most = field.response.white / float(np.quantile(times, 0.75, method="lower"))
    white = _reference_white(np.minimum(whites, most), radiance.amax(1), pixels)
    measured, of_all = torch.zeros_like(pixels), torch.full_like(pixels, 1e-12)
    brightness = pixels.new_zeros(len(pixels), 2)
    counts = np.repeat([len(part) / max(1, len(some)) for part, some in zip(parts, samples)], [*map(len, samples)])
    unclipped = torch.zeros(len(cameras), len(pixels), dtype=torch.bool, device=pixels.device)
    for index, (camera, limit, each, count) in enumerate(zip(cameras, whites, received, counts, strict=True)):
        of_all += count * each.pixels
        image = field.render(camera, degree=degree).hdr.to(pixels.device)
        brightness += _brightness_by(field, camera, image)
        if limit >= 2 * white:
            below_white = _unclipped_by(field, camera, image, limit)
            measured += count * below_white
            unclipped[index] = below_white > 0
    agree = 1 - clipped.to(measured.device) > measured / of_all / 2  # Photos clip, too, where the scene is too dark.
    measured = (measured > LEAST_MEASURED) & agree
    focal = typical_focal_length(cameras)
    brightness /= pixels.clamp_min(1e-20)[:, None]
    return Photos(cameras, received, white, unclipped, measured, focal, whites, pixels, radiance, brightness)


def _candidates(field: RadianceField, clipped: Tensor, photos: Photos) -> Candidates:
    """Return the Gaussians that are bright, that photos show, and most of whose bright values clip."""
    peak, device = photos.radiance.amax(1), photos.radiance.device
    too_bright = torch.zeros_like(peak)
    for received, white in zip(photos.received, photos.whites, strict=True):
        if white < 2 * photos.white:  # Photos of half the exposure or less measure lights, so these do not count.
            too_bright += received.pixels * (peak > BRIGHT * white)
    # The share is lower if the scene contradicts the other photos, which then weigh more.
    weighted = too_bright + RESIDUAL_WEIGHT * (photos.pixels - too_bright)
    clips = clipped.to(device) >= CLIPPED * too_bright / weighted.clamp_min(1e-20)
    index = (clips & (photos.pixels > LEAST_SEEN) & (peak > BRIGHT * photos.white)).nonzero()[:, 0]
    gaussians, stops = field.gaussians, field.clipped_stops
    axes = torch.diag_embed(gaussians.log_scales[index].exp()).flatten(0, 1)
    axes = rotate(gaussians.quaternions[index].repeat_interleave(3, 0), axes).unflatten(0, (-1, 3))
    confidence = torch.ones_like(peak) if field.confidence is None else field.confidence.to(device)
    return Candidates(
        index=index,
        positions=field.normalization.scene_points(gaussians.means[index].cpu().numpy()),
        axes=axes.cpu().numpy() * field.normalization.unit,
        weights=(photos.pixels * photos.radiance.mean(1))[index].cpu().numpy(),
        brightness=peak[index].cpu().numpy(),
        too_bright=(too_bright > 0)[index].cpu().numpy(),
        measured=photos.measured[index].cpu().numpy(),
        unclipped=photos.unclipped[:, index].cpu().numpy(),
        clipped=clipped.to(device)[index].cpu().numpy(),
        stops=None if stops is None else stops.to(device)[index].cpu().numpy(),
        doubt=-confidence[index].clamp_min(2.0**-8).log2().cpu().numpy(),
        angles=np.stack([each.angles[index].cpu().numpy() for each in photos.received]),
        light=np.stack([each.light[index].cpu().numpy() for each in photos.received]),
        pixel_brightness=photos.brightness[index].cpu().numpy(),
    )


def _whole_photos(cameras: Sequence[Camera], group: Candidates, core: Candidates, shape: LightShape) -> _LightPhotos:
    """Return the photos that do not cut the light off at their border and see its face."""
    whole = [_in_frame(camera, group.positions, group.longest, group.weights) for camera in cameras]
    photos = np.flatnonzero(whole & (solid_angles(shape, cameras) > 0))
    return _LightPhotos(photos, core.angles.sum(1)[photos], group.light.sum(1)[photos])


def _reference_white(whites: np.ndarray, radiance: Tensor, pixels: Tensor) -> float:
    """Return the white that lights exceed: the lowest of the photos' at which at most MOST_CLIPPED would clip.

    Args:
        whites: Radiance of the photos' whites. The largest is returned if more would clip at all of them.
        radiance: [N] of the Gaussians.
        pixels: [N] that show them.
    """
    for white in np.unique(whites):
        if float(pixels[radiance > white].sum()) <= MOST_CLIPPED * float(pixels.sum()):
            return float(white)
    return float(whites.max())


def _panorama(position: np.ndarray, focal: float) -> Camera:
    """Return a camera at a point that sees all directions in pixels of about the photos' focal length."""
    rows = int(np.clip(np.pi * focal, LEAST_ROWS, MOST_ROWS))
    pose = np.eye(4)
    pose[:3, 3] = -position
    return Camera(2 * rows, rows, rows / np.pi, rows / np.pi, rows, rows / 2, pose, "equirectangular")


def _received_by(
    field: RadianceField,
    camera: Camera,
    degree: int | None,
    opacities: Tensor | None = None,
    *,
    at_place: bool = False,
) -> ReceivedLight:
    """Return what a camera receives of each Gaussian; `at_place` as of weighted_sums()."""
    device = field.gaussians.means.device
    angle = torch.tensor(steradians(camera), dtype=torch.float32, device=device)
    # Sums of small angles stay numbers of about 1.
    unit = float(angle.mean())
    images = torch.stack([torch.ones_like(angle), angle / unit], 2)
    sums = field.weighted_sums(field.camera_tensors(camera), images, opacities, at_place=at_place)
    radiance = field.radiance_towards(camera.position, degree=degree)
    return ReceivedLight(sums[:, 0], sums[:, 1] * unit, radiance * (sums[:, 1:] * unit))


def _brightness_by(field: RadianceField, camera: Camera, image: Tensor) -> Tensor:
    """Return sums [N, 2] of the brightness of the pixels [H, W, 3] of a camera, and of its square."""
    mean = image.mean(2)
    return field.weighted_sums(field.camera_tensors(camera), torch.stack([mean, mean**2], 2))


def _unclipped_by(field: RadianceField, camera: Camera, image: Tensor, white: float) -> Tensor:
    """Return the pixels [N] of each Gaussian that a camera shows, 0 if most of them are as bright as its white.

    A Gaussian that blends with darker ones may be brighter than all pixels, which `image` [H, W, 3] is a render of.
    """
    brightest = image.amax(2)
    images = torch.stack([torch.ones_like(brightest), (brightest < white).to(brightest)], 2)
    pixels, unclipped = field.weighted_sums(field.camera_tensors(camera), images).unbind(1)
    return torch.where(unclipped > pixels / 2, pixels, 0)


def _in_frame(camera: Camera, positions: np.ndarray, longest: np.ndarray, weights: np.ndarray) -> bool:
    """Return whether a photo holds a light: nearly all of the weight of its Gaussians, out to EXTENT widths."""
    if camera.projection == "equirectangular":
        return True
    places = positions @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depths = places[:, 2] if camera.is_pinhole else np.linalg.norm(places, axis=1)
    before = depths > 0
    depths = np.where(before, depths, 1.0)
    if camera.is_pinhole:
        u, v = (places[:, :2] / depths[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]).T
    else:
        v, u = pixels_of_directions(places / depths[:, None], camera).T + 0.5
    margin = EXTENT * np.linalg.norm(longest, axis=1) * max(camera.fx, camera.fy) / depths
    inside = (margin <= u) & (u <= camera.width - margin) & (margin <= v) & (v <= camera.height - margin)
    return bool(weights[before & inside].sum() >= WHOLE * weights.sum())
