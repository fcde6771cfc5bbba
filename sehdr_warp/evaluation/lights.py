"""Compare the lights of the truth with those of a trained scene: how many are lost, how much energy the rest has.

Lights are bright regions of the views, joined across views by the points in space that they show.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..scene import Camera

BRIGHT = 10.0  # A pixel belongs to a light if its radiance is above this multiple of its view's mean
MIN_PIXELS = 6  # Pixels of the smallest region that counts as a light
MIN_SHARE = 0.5  # Part of its radiance with which a region must be rendered, else it counts as lost
MARGIN = 2  # Pixels around a region whose light counts as the light's energy, because renders blur its edge
MAX_AREA_RATIO = 3.3  # Largest ratio between the areas of two regions that can show the same light
TOLERANCE_PIXELS, TOLERANCE_RADII = 1.0, 0.35
"""Largest distance of a light's point from the center of its region: pixels, plus this part of the region's radius."""


@dataclass(frozen=True, eq=False)
class LightRegion:
    """A connected bright region in one view."""

    camera: Camera  # Of the view
    center: np.ndarray  # x and y, pixels
    area: int  # Pixels
    direction: np.ndarray  # Unit vector from the camera to the center, in the scene's axes
    share: float  # The part of its radiance that is rendered
    true_energy: float  # Sum of the true radiance over its pixels and MARGIN pixels around
    rendered_energy: float  # The same of the render
    clipped: bool  # Whether the photo shows most of its pixels as white


def light_regions(
    truth: np.ndarray, render: np.ndarray, camera: Camera, clipped: np.ndarray | None = None
) -> list[LightRegion]:
    """Find the regions of at least MIN_PIXELS connected pixels above BRIGHT times the mean of a view's truth.

    Args:
        truth: radiance, [H, W].
        render: radiance in the same unit, [H, W].
        camera: of the view.
        clipped: the pixels that the view's photo shows as white, [H, W] bool; None if none is.
    """
    from scipy import ndimage

    regions = []
    labels = np.empty(truth.shape, np.int32)
    ndimage.label(truth > BRIGHT * truth.mean(), np.ones((3, 3)), output=labels)
    for index, window in enumerate(ndimage.find_objects(labels), start=1):
        inside = labels[window] == index
        if (area := int(inside.sum())) >= MIN_PIXELS:
            offsets = zip(np.nonzero(inside), window, strict=True)
            row, column = (axis.mean() + part.start + 0.5 for axis, part in offsets)
            ray = np.array([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0])
            direction = camera.world_to_camera[:3, :3].T @ (ray / np.linalg.norm(ray))
            share = float(render[window][inside].mean() / truth[window][inside].mean())
            wide = tuple(slice(max(0, part.start - MARGIN), part.stop + MARGIN) for part in window)
            dilated = ndimage.binary_dilation(labels[wide] == index, np.ones((3, 3)), iterations=MARGIN)
            around = np.asarray(dilated, bool)
            white = clipped is not None and bool(clipped[window][inside].mean() > 0.5)
            regions.append(
                LightRegion(
                    camera=camera,
                    center=np.array([column, row]),
                    area=area,
                    direction=direction,
                    share=share,
                    true_energy=float(truth[wide][around].sum()),
                    rendered_energy=float(render[wide][around].sum()),
                    clipped=white,
                )
            )
    return regions


def count_lights(regions: Sequence[LightRegion]) -> dict[str, Any]:
    """Count the lights that two views or more show, and those that the renders lost, and compare their energy.

    A light is lost if more than half of its regions are rendered with less than MIN_SHARE of their radiance.

    Args:
        regions: of all views.

    Returns:
        "count"; "lost"; "energies": rendered over true energy, summed over its regions, of each light that most of its
        regions clip, ascending.
    """
    remaining, lights = list(regions), []
    while remaining:
        largest = max(remaining, key=lambda region: region.area)
        groups = [_regions_at(point, remaining) for point in _intersections(largest, remaining)]
        lights.append(max((group for group in groups if largest in group), key=len, default=[largest]))
        remaining = [region for region in remaining if region not in lights[-1]]
    confirmed = [light for light in lights if len(light) > 1]
    missing = sum(np.mean([region.share < MIN_SHARE for region in light]) > 0.5 for light in confirmed)
    clipped = [light for light in confirmed if np.mean([region.clipped for region in light]) > 0.5]
    energies = [
        sum(each.rendered_energy for each in light) / sum(each.true_energy for each in light) for light in clipped
    ]
    return {"count": len(confirmed), "lost": int(missing), "energies": sorted(energies)}


def _intersections(region: LightRegion, others: Sequence[LightRegion]) -> Iterator[np.ndarray]:
    """Yield the points where a region's ray comes nearest to the rays of regions of similar area in other views."""
    for other in others:
        normal = np.cross(region.direction, other.direction)
        square, offset = float(normal @ normal), other.camera.position - region.camera.position
        similar = 1 / MAX_AREA_RATIO < other.area / region.area < MAX_AREA_RATIO
        if other.camera is region.camera or not similar or square < 1e-6:
            continue
        depth = np.cross(offset, other.direction) @ normal / square
        other_depth = np.cross(offset, region.direction) @ normal / square
        if min(depth, other_depth) > 0:
            nearest = region.camera.position + depth * region.direction
            other_nearest = other.camera.position + other_depth * other.direction
            yield np.mean([nearest, other_nearest], axis=0)


def _regions_at(point: np.ndarray, regions: Sequence[LightRegion]) -> list[LightRegion]:
    """Return the region of each view that shows a point, if there is one."""
    nearest: dict[int, tuple[float, LightRegion]] = {}
    for region in regions:
        camera = region.camera
        x, y, depth = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
        if depth <= 0:
            continue
        projected = np.array([camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy])
        distance = float(np.linalg.norm(projected - region.center))
        tolerance = TOLERANCE_PIXELS + TOLERANCE_RADII * np.sqrt(region.area / np.pi)
        if distance < min(tolerance, nearest.get(id(camera), (np.inf,))[0]):
            nearest[id(camera)] = (distance, region)
    return [region for _, region in nearest.values()]
