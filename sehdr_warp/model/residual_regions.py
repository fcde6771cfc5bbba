"""Regions in which a trained scene differs from its photos by a stop or more."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
import torch

from ..progress import track_progress
from ..response import Response
from ..response.curve import HALF_CODE
from ..scene import View
from ..subsets import every_nth
from .radiance_field import RadianceField

log = logging.getLogger(__name__)

# A pixel differs if both are exceeded: noise in dark areas is many stops, and a code in bright areas much light.
MIN_STOPS, MIN_CODE_DIFFERENCE = 1.0, 0.1
MIN_PIXELS = 6
MAX_LISTED = 20
_EXPOSED = 0.1, 0.95  # Codes of pixels whose brightness a photo shows well
_LEAST_EXPOSED = 0.05  # Part of such pixels, from which the brightness of a photo is compared
MAX_VIEWS = 200  # Training views that are compared, evenly chosen; more change the means little


@dataclass(frozen=True)
class Region:
    """A connected region of a photo that the scene does not reproduce; positions: pixels at the size of training."""

    photo: str  # Name of the view
    column: float  # Horizontal center
    row: float  # Vertical center
    pixels: int  # Area
    stops: float  # Mean brightness of the photo above that of the scene; a bound if either is clipped or black
    box: tuple[int, int, int, int]  # Left, top, width and height of the bounding box


class PhotoComparison(NamedTuple):
    """Difference of a scene from its photos."""

    regions: list[Region]  # Regions that the scene does not reproduce, largest area times stops first
    # Stops by which whole photos are brighter than the scene, by the views' names: the median over pixels that are
    # neither clipped nor dark, less the median over photos. Photos with few such pixels are left out
    brightness_offsets: dict[str, float]


@torch.no_grad()
def compare_photos(field: RadianceField, views: Sequence[View], *, degree: int | None = None) -> PhotoComparison:
    """Compare a field with photos.

    At most MAX_VIEWS photos are compared, evenly chosen. Regions smaller than MIN_PIXELS, and lines one pixel wide
    as edges leave them, are ignored.
    """
    regions, medians = [], {}
    compared = every_nth(views, MAX_VIEWS)
    for _, view in track_progress("comparing photos with the scene", compared, log):
        exposure = field.render(view.camera, degree=degree).hdr * view.exposure_time
        photo = view.image
        stops, code = _differences(view, photo, exposure, field.response)
        for labels, sizes in _labels(stops, code):
            regions += _regions(view.name, labels, sizes, stops)
        exposed = ((photo > _EXPOSED[0]) & (photo < _EXPOSED[1])).all(2)
        exposed &= True if view.mask is None else view.mask > 0.5
        if exposed.mean() > _LEAST_EXPOSED:
            medians[view.name] = float(np.median(stops[exposed]))
    middle = float(np.median(list(medians.values()))) if medians else 0.0
    offsets = {name: round(value - middle, 2) for name, value in medians.items()}
    return PhotoComparison(sorted(regions, key=lambda region: -region.pixels * abs(region.stops)), offsets)


def high_residual_mask(view: View, exposure: torch.Tensor, response: Response) -> torch.Tensor:
    """Return a [H, W] bool mask of the pixels in regions where a photo differs from the scene's exposure [H, W, 3]."""
    mask = np.zeros(exposure.shape[:2], bool)
    for labels, sizes in _labels(*_differences(view, view.image, exposure, response)):
        mask |= (sizes >= MIN_PIXELS)[labels]
    return torch.from_numpy(mask).to(exposure.device)


def _labels(stops: np.ndarray, code: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield a [H, W] int32 number of each pixel's region, 0 outside, and the regions' sizes [N + 1], that of 0 being 0.

    Regions that are too bright and too dark come separately: one that is both has a mean difference of 0.
    """
    from scipy import ndimage

    for sign in (1, -1):
        large = (sign * stops >= MIN_STOPS) & (code >= MIN_CODE_DIFFERENCE)
        labels = np.empty(stops.shape, np.int32)
        ndimage.label(ndimage.binary_opening(large, np.ones((2, 2))), np.ones((3, 3)), output=labels)
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        yield labels, sizes


def _regions(photo: str, labels: np.ndarray, sizes: np.ndarray, stops: np.ndarray) -> Iterator[Region]:
    """Yield the regions of MIN_PIXELS and more."""
    from scipy import ndimage

    large = np.flatnonzero(sizes >= MIN_PIXELS)
    if not len(large):
        return
    rows, columns = np.nonzero(labels)
    index = labels[rows, columns]
    row, column, mean = (
        np.bincount(index, values, len(sizes)) / np.maximum(sizes, 1)
        for values in (rows, columns, stops[rows, columns])
    )
    boxes = ndimage.find_objects(labels)
    for each in large:
        down, across = boxes[each - 1]
        box = across.start, down.start, across.stop - across.start, down.stop - down.start
        middle = round(float(column[each]) + 0.5, 1), round(float(row[each]) + 0.5, 1)
        yield Region(photo, *middle, int(sizes[each]), round(float(mean[each]), 2), box)


def _differences(
    view: View, image: np.ndarray, exposure: torch.Tensor, response: Response
) -> tuple[np.ndarray, np.ndarray]:
    """Return two [H, W] arrays: stops by which a view's image is brighter, and the largest difference of codes.

    Both are 0 if the photo is clipped and the scene at white, and where a mask excludes the photo.
    """
    photo = torch.from_numpy(image).to(exposure.device)
    rendered = response.encode_extended(exposure).clamp(0, 1)
    # A photo does not distinguish exposures below half a code.
    light = [response.decode(encoded.clamp_min(HALF_CODE)).mean(2) for encoded in (photo, rendered)]
    stops, code = (light[0] / light[1]).log2(), (photo - rendered).abs().amax(2)
    weight = 1.0 if view.mask is None else view.mask > 0.5
    return stops.cpu().numpy() * weight, code.cpu().numpy()


def regions_to_dict(regions: Sequence[Region]) -> dict:
    """Return the counts and the worst regions as plain values for summary.json."""
    photos = len({region.photo for region in regions})
    return {"regions": len(regions), "photos": photos, "worst": [asdict(region) for region in regions[:MAX_LISTED]]}
