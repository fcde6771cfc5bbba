"""Which lights of the truth a trained scene holds: bright regions of the views, joined by the places they point at."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..scene import Camera

BRIGHT = 10.0  # Times the view's mean, from which a pixel belongs to a light
LEAST_PIXELS = 6
LEAST_SHARE = 0.5  # Of its radiance that a region must be rendered with
LARGEST_RATIO = 3.3  # Between the areas of two regions of one light
TOLERANCE = 1.0, 0.35  # Pixels, and parts of a region's radius, by which a light's place may miss the region's middle


@dataclass(frozen=True, eq=False)
class LightRegion:
    """A connected bright region of a camera's view: its middle and area in pixels, the direction from the camera to it,
    and the share of its radiance that is rendered."""

    camera: Camera
    middle: np.ndarray
    area: int
    direction: np.ndarray
    share: float


def light_regions(truth: np.ndarray, render: np.ndarray, camera: Camera) -> list[LightRegion]:
    """The regions of at least LEAST_PIXELS connected pixels above BRIGHT times the mean of a view's truth.

    truth, render: [H, W] radiance in one unit.
    """
    from scipy import ndimage

    found = []
    labels = np.empty(truth.shape, np.int32)
    ndimage.label(truth > BRIGHT * truth.mean(), np.ones((3, 3)), output=labels)
    for index, place in enumerate(ndimage.find_objects(labels), start=1):
        inside = labels[place] == index
        if (area := int(inside.sum())) >= LEAST_PIXELS:
            row, column = (axis.mean() + part.start + 0.5 for axis, part in zip(np.nonzero(inside), place, strict=True))
            ray = np.array([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0])
            direction = camera.world_to_camera[:3, :3].T @ (ray / np.linalg.norm(ray))
            share = float(render[place][inside].mean() / truth[place][inside].mean())
            found.append(LightRegion(camera, np.array([column, row]), area, direction, share))
    return found


def count_lights(regions: Sequence[LightRegion]) -> dict[str, int]:
    """{"count": lights that two views or more show, "lost": how many of them the renders do not hold}.

    A light is lost whose regions are rendered at less than half their radiance in more than half of the views that
    show it. regions: those of all views.
    """
    left, lights = list(regions), []
    while left:
        largest = max(left, key=lambda region: region.area)
        groups = [_pointed_at(place, left) for place in _meetings(largest, left)]
        lights.append(max((group for group in groups if largest in group), key=len, default=[largest]))
        left = [region for region in left if region not in lights[-1]]
    seen = [light for light in lights if len(light) > 1]
    lost = sum(np.mean([region.share < LEAST_SHARE for region in light]) > 0.5 for light in seen)
    return {"count": len(seen), "lost": int(lost)}


def _meetings(one: LightRegion, regions: Sequence[LightRegion]) -> Iterator[np.ndarray]:
    """Where the rays of a region and of each region of another view and of like area come nearest to each other."""
    for other in regions:
        normal = np.cross(one.direction, other.direction)
        square, apart = float(normal @ normal), other.camera.position - one.camera.position
        alike = 1 / LARGEST_RATIO < other.area / one.area < LARGEST_RATIO
        if other.camera is one.camera or not alike or square < 1e-6:
            continue
        depths = [np.cross(apart, ray) @ normal / square for ray in (other.direction, one.direction)]
        if min(depths) > 0:
            ends = [r.camera.position + depth * r.direction for r, depth in zip((one, other), depths, strict=True)]
            yield np.mean(ends, axis=0)


def _pointed_at(place: np.ndarray, regions: Sequence[LightRegion]) -> list[LightRegion]:
    """The region of each view, if there is one, that lies over a place."""
    nearest: dict[int, tuple[float, LightRegion]] = {}
    for region in regions:
        camera = region.camera
        x, y, depth = camera.world_to_camera[:3, :3] @ place + camera.world_to_camera[:3, 3]
        if depth <= 0:
            continue
        seen = np.array([camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy])
        miss = float(np.linalg.norm(seen - region.middle))
        allowed = TOLERANCE[0] + TOLERANCE[1] * np.sqrt(region.area / np.pi)
        if miss < min(allowed, nearest.get(id(camera), (np.inf,))[0]):
            nearest[id(camera)] = (miss, region)
    return [region for _, region in nearest.values()]
