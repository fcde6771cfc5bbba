"""Lights of a trained scene: groups of bright Gaussians that the photos clipped, as simple emitting shapes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from ..scene import Camera
from ..scene.wide_camera import pixels_of_directions, steradians, typical_focal_length
from ..subsets import every_nth
from .confidence import RESIDUAL_WEIGHT
from .radiance_field import RadianceField

CLIPPED = 0.3  # Share of the values of photos too bright for a Gaussian that clip, from which it can belong to a light
BRIGHT = 0.7  # Times white, from which a Gaussian can belong to a light, and from which a photo is too bright for it
MOST_CLIPPED = 0.1  # Share of all photos' pixels that may clip at the exposure whose white decides what a light is
LEAST_SEEN = 0.3  # Pixels of blending weight over all views, likewise
REACH = 3.0  # Gaussians join one light if they are nearer than this many median standard deviations
FLATNESS = 0.15  # Of the smallest to the middle variance, below which a light is a flat rectangle
EXTENT, WHOLE = 2.0, 0.95  # A photo holds a light if this share of its weight lies within, out to so many widths
LEAST_SHARE = 5e-4  # Of the light at the middle of the cameras, if nothing hides the light from there
MEASURED_STOPS = 0.25  # Deviation of light that a darker photo shows unclipped: surfaces are lit within 7 to 19 % then
UNOBSTRUCTED = 0.5  # Of what most views show of a light: those that show less count as obstructed
MOST_LIGHTS, MOST_VIEWS = 64, 24  # MOST_VIEWS of the longest exposures, and of those of half of these or less
LEAST_ROWS, MOST_ROWS = 128, 724
"""Rows of the map in which the light at a point is measured: as fine as the photos' pixels, within these bounds. In
coarser pixels small Gaussians would no longer hide each other."""


@dataclass(frozen=True, eq=False)
class LightShape:
    """A rectangle or a sphere, in the scene's coordinates.

    Attributes:
        kind: "rect" or "sphere".
        position: [3] middle.
        axes: [3, 3] rows: along the width, along the height, and the direction that a rectangle emits to.
        size: width and height of a rectangle; the diameter of a sphere, twice.
    """

    kind: str
    position: np.ndarray
    axes: np.ndarray
    size: tuple[float, float]

    def solid_angle(self, point: np.ndarray) -> float:
        """Return the solid angle that a point sees of a light; 0 from behind a rectangle, 2 pi within a sphere."""
        towards = self.axes @ (point - self.position)
        if self.kind == "sphere":
            sine = min(self.size[0] / 2 / max(float(np.linalg.norm(towards)), 1e-12), 1.0)
            return float(2 * np.pi * sine**2 / (1 + np.sqrt(1 - sine**2)))
        if towards[2] <= 0:
            return 0.0
        u, v = (towards[i] + np.array([0.5, -0.5]) * self.size[i] for i in (0, 1))
        corners = np.arctan2(np.outer(u, v), towards[2] * np.sqrt(u[:, None] ** 2 + v**2 + towards[2] ** 2))
        return float(corners[0, 0] - corners[0, 1] - corners[1, 0] + corners[1, 1])


@dataclass(frozen=True, eq=False)
class Light:
    """One light of a scene.

    Attributes:
        shape: its place and size.
        radiance: [3] in the field's colors; with the shape it gives the light that training views show, of those
            from which nothing hides it. If each view cuts the light off at its border, it is what reaches the place of
            the one that shows most of it.
        lower_bound: [3] certain radiance: the photos' white, or less where the light has less of a color.
        deviation: of log2 radiance, stops, of what photos clip; None if that was not measured. Edges and colors that do
            not clip do not count, because all its photos may err alike; where photos of half the exposure or less do
            not clip, it is at most MEASURED_STOPS, or what the scene differs from unclipped values.
        share: of the light that reaches the middle of the training cameras, with what hides it from there.
        members: [K] int64, its Gaussians.
    """

    shape: LightShape
    radiance: np.ndarray
    lower_bound: np.ndarray
    deviation: float | None
    share: float
    members: Tensor


def light_name(index: int) -> str:
    """Return the name of the light at an index of find_lights(), as files, tables, reports and the viewer have it."""
    return f"light_{index}"


@torch.no_grad()
def received_light(
    field: RadianceField, position: np.ndarray, focal: float, *, beyond: float = 0.0, degree: int | None = None
) -> tuple[Tensor, Tensor]:
    """Return what a point receives of each Gaussian: the solid angle [N] that nothing hides, and light [N, 3] from it.

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
    return _view_sums(field, _panorama(position, focal), degree, opacities)[1:]


@torch.no_grad()
def find_lights(
    field: RadianceField,
    clipped: Tensor,
    views: Sequence[tuple[Camera, float]],
    *,
    degree: int | None = None,
) -> list[Light]:
    """Return the lights of a scene, those that give most first.

    Args:
        field: a trained scene.
        clipped: [N] in [0, 1], which share of the values that show a Gaussian was clipped; on any device.
        views: training cameras in the scene's coordinates, with their exposure times in seconds.
        degree: of the harmonics; by default all.
    """
    if not views:
        return []
    times = np.array([time for _, time in views])
    longest = times > times.max() / 2
    middle = np.mean([camera.position for camera, _ in views], axis=0)
    sample = [index for part in (longest, ~longest) for index in every_nth(part.nonzero()[0], MOST_VIEWS)]
    cameras, whites = [views[index][0] for index in sample], field.response.white / times[sample]
    focal = typical_focal_length(cameras)

    @cache
    def sums_around(index: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return what all directions from a photo's place receive, as of _view_sums()."""
        return _view_sums(field, _panorama(cameras[index].position, focal), degree)

    sums = [_view_sums(field, camera, degree) for camera in cameras]
    pixels, angles, flux = (sum(parts) for parts in zip(*sums, strict=True))
    mean = flux / angles.clamp_min(1e-20)[:, None]  # pyright: ignore[reportAttributeAccessIssue]
    peak = mean.amax(1)
    most = field.response.white / float(np.quantile(times, 0.75, method="lower"))
    white = _reference_white(np.minimum(whites, most), peak, pixels)  # pyright: ignore[reportArgumentType]
    # Photos of half the exposure or less measure lights and do not clip them, so these do not count.
    usual = [(part[0], each) for part, each in zip(sums, whites, strict=True) if each < 2 * white]
    too_bright = torch.zeros_like(peak)
    for seen, each in usual:
        too_bright += seen * (peak > BRIGHT * each)
    # The share is lower if the scene contradicts the other photos, which then weigh more.
    weighted = too_bright + RESIDUAL_WEIGHT * (pixels - too_bright)
    clips = clipped.to(mean.device) >= CLIPPED * too_bright / weighted.clamp_min(1e-20)
    members = (clips & (pixels > LEAST_SEEN) & (peak > BRIGHT * white)).nonzero()[:, 0]
    # Radiance up to which each photo measures what photos of the reference exposure clip.
    measurable = np.where(whites >= 2 * white, whites, 0.0)
    if not len(members):
        return []
    gaussians = field.gaussians
    positions = field.normalization.scene_points(gaussians.means[members].cpu().numpy())
    widths = gaussians.log_scales[members].exp().amax(1).cpu().numpy() * field.normalization.unit
    weights = (pixels * mean.mean(1))[members].cpu().numpy()
    certain = (too_bright > 0)[members].cpu().numpy()
    brightness = peak[members].cpu().numpy()
    uncertainty = None if field.clipped_stops is None else field.clipped_stops.to(members.device)[members].cpu().numpy()
    confidence = torch.ones_like(peak) if field.confidence is None else field.confidence.to(peak.device)
    doubt = -confidence[members].clamp_min(2.0**-8).log2().cpu().numpy()
    shares = clipped.to(members.device)[members].cpu().numpy()
    covered, received = (np.stack([part[i][members].cpu().numpy() for part in sums]) for i in (1, 2))
    reaches_middle = received_light(field, middle, focal, degree=degree)[1].mean(1)
    total = max(float(reaches_middle.sum()), 1e-30)
    lights = []
    for group in _groups(positions, REACH * float(np.median(widths))):
        if weights[group] @ certain[group] < CLIPPED * weights[group].sum():
            continue  # Darker photos alone show most of it and do not clip it, as the part of a walk in the sun.
        shape = _shape(positions[group], widths[group], weights[group], middle)
        whole = [_in_frame(camera, positions[group], widths[group], weights[group]) for camera in cameras]
        angles_of_shape = np.array([shape.solid_angle(camera.position) for camera in cameras])
        holding = np.flatnonzero(whole & (angles_of_shape > 0))
        area_sums, light_sums = covered[:, group].sum(1, keepdims=True)[holding], received[:, group].sum(1)[holding]
        if not len(holding):
            # Every photo cuts the light off at its border. The one that shows most of it looks beyond that.
            best = int(np.argmax(covered[:, group].sum(1) * (angles_of_shape > 0)))
            part = [values[members][group].cpu().numpy().sum(0) for values in sums_around(best)[1:]]
            holding, area_sums, light_sums = np.array([best]), part[0].reshape(1, 1), part[1][None]
        # Something hides the light from views that show far less of it than others.
        fractions = area_sums[:, 0] / angles_of_shape[holding]
        unobstructed = fractions >= UNOBSTRUCTED * np.quantile(fractions, 0.9)
        area_sums, light_sums, holding = area_sums[unobstructed], light_sums[unobstructed], holding[unobstructed]
        places = [cameras[index].position for index in holding]
        area = float(_fit(shape, area_sums, places)[0])
        # As large as it looks: the pixels of the photos blur small lights, and Gaussians reach beyond their centers.
        sides = [side * min(max(area, 1e-4), 1e4) ** 0.5 for side in shape.size]
        shape = replace(shape, size=(sides[0], sides[1]))
        radiance = _fit(shape, light_sums, places)
        deviation = None
        if uncertainty is not None:
            clip = np.maximum(shares[group], 1e-6)
            stops = uncertainty[group] / clip
            measured = brightness[group] < measurable[holding].max()
            # The scene may contradict the photos that measure it.
            misfit = np.maximum(doubt[group] - uncertainty[group], 0) / np.maximum(1 - shares[group], 1e-6)
            stops[measured] = np.minimum(stops, np.maximum(misfit, MEASURED_STOPS))[measured]
            deviation = float(np.average(stops, weights=weights[group] * clip))
        index = members[torch.from_numpy(group).to(members.device)]
        share = float(reaches_middle[index].sum()) / total
        if radiance.mean() * shape.solid_angle(middle) >= LEAST_SHARE * total:  # Also if something hides it from there
            bound = np.minimum(white, radiance)
            lights.append(Light(shape, radiance, bound, deviation, share, index))
    return sorted(lights, key=lambda light: -light.share)[:MOST_LIGHTS]


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


def _view_sums(
    field: RadianceField, camera: Camera, degree: int | None, opacities: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what a camera receives of each Gaussian: pixels [N], their solid angle [N], and light times it [N, 3]."""
    device = field.gaussians.means.device
    angle = torch.tensor(steradians(camera), dtype=torch.float32, device=device)
    # Sums of small angles stay numbers of about 1.
    unit = float(angle.mean())
    images = torch.stack([torch.ones_like(angle), angle / unit], 2)
    sums = field.weighted_sums(field.camera_tensors(camera), images, opacities)
    radiance = field.radiance_towards(camera.position, degree=degree)
    return sums[:, 0], sums[:, 1] * unit, radiance * (sums[:, 1:] * unit)


def _groups(positions: np.ndarray, reach: float) -> list[np.ndarray]:
    """Return the connected groups of points that are nearer to each other than `reach`, as indices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    pairs = KDTree(positions).query_pairs(reach, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), (len(positions), len(positions)))
    count, labels = connected_components(links, directed=False)
    return [np.flatnonzero(labels == label) for label in range(count)]


def _shape(positions: np.ndarray, widths: np.ndarray, weights: np.ndarray, middle: np.ndarray) -> LightShape:
    """Return the rectangle or sphere with the weighted mean and variances of Gaussians."""
    weights = weights / weights.sum()
    position = weights @ positions
    offsets = positions - position
    covariance = (offsets * weights[:, None]).T @ offsets
    values, vectors = np.linalg.eigh(covariance)
    # A Gaussian reaches beyond its center on the light's face, but not across a flat one.
    spread = float(weights @ widths**2)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1].T
    flat = values[2] < FLATNESS * values[1]
    if not flat:
        diameter = 2 * float(np.sqrt(values.sum() + spread))
        return LightShape("sphere", position, np.eye(3), (diameter, diameter))
    normal = vectors[2] if vectors[2] @ (middle - position) >= 0 else -vectors[2]
    axes = np.stack([vectors[0], np.cross(normal, vectors[0]), normal])
    width, height = (float(np.sqrt(12 * (value + spread))) for value in values[:2])
    return LightShape("rect", position, axes, (width, height))


def _fit(shape: LightShape, received: np.ndarray, places: Sequence[np.ndarray]) -> np.ndarray:
    """Return the values [C] whose products with a shape's solid angles are what views at places receive [V, C].

    By least squares: the radiance of light, or the area of a solid angle as a multiple of the shape's.
    """
    angles = np.array([shape.solid_angle(place) for place in places])
    square = angles @ angles
    return angles @ received / square if square > 0 else np.zeros(received.shape[1])


def _in_frame(camera: Camera, positions: np.ndarray, widths: np.ndarray, weights: np.ndarray) -> bool:
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
    margin = EXTENT * widths * max(camera.fx, camera.fy) / depths
    inside = (margin <= u) & (u <= camera.width - margin) & (margin <= v) & (v <= camera.height - margin)
    return bool(weights[before & inside].sum() >= WHOLE * weights.sum())
