"""Regions in which a trained scene differs from its photos by a stop or more."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch

from ..progress import tracked
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
_EXPOSED = 0.1, 0.95  # Codes of pixels whose brightness a photo tells well
_LEAST_EXPOSED = 0.05  # Part of such pixels, from which the brightness of a photo is compared
MAX_VIEWS = 200  # Training views that are compared, evenly chosen; more change the means little


@dataclass(frozen=True)
class Region:
    """A connected region of a photo that the scene does not reproduce; positions are in pixels at the size of training.

    Attributes:
        photo: Name of the view.
        column: Horizontal centre.
        row: Vertical centre.
        pixels: Area.
        stops: Mean brightness of the photo above that of the scene; a bound if either is clipped or black.
        box: Left, top, width and height of the bounding box.
    """

    photo: str
    column: float
    row: float
    pixels: int
    stops: float
    box: tuple[int, int, int, int]


@torch.no_grad()
def find_residual_regions(field: RadianceField, views: Sequence[View], *, degree: int | None = None) -> list[Region]:
    """Find regions in which a field differs from photos, largest area times stops first.

    At most MAX_VIEWS photos are compared, evenly chosen. Regions smaller than MIN_PIXELS, and lines one pixel wide
    as edges leave them, are ignored.
    """
    regions = []
    compared = every_nth(views, MAX_VIEWS)
    for _, view in tracked("comparing photos with the scene", compared, log):
        exposure = field.render(view.camera, degree=degree).hdr * view.exposure_time
        for row, column, stops in _regions(view, exposure, field.response):
            first_column, top = int(column.min()), int(row.min())
            middle = round(float(column.mean()) + 0.5, 1), round(float(row.mean()) + 0.5, 1)
            box = first_column, top, int(column.max()) - first_column + 1, int(row.max()) - top + 1
            regions.append(Region(view.name, *middle, len(row), round(float(stops.mean()), 2), box))
    return sorted(regions, key=lambda region: -region.pixels * abs(region.stops))


@torch.no_grad()
def brightness_offsets(field: RadianceField, views: Sequence[View], *, degree: int | None = None) -> dict[str, float]:
    """Return the stops by which whole photos are brighter than the scene, by the views' names.

    It is the median over pixels that are neither clipped nor dark, less the median over photos. Photos with few such
    pixels are left out. At most MAX_VIEWS photos are compared, evenly chosen.
    """
    medians = {}
    for view in every_nth(views, MAX_VIEWS):
        exposure = field.render(view.camera, degree=degree).hdr * view.exposure_time
        stops, _ = _differences(view, exposure, field.response)
        exposed = ((view.image > _EXPOSED[0]) & (view.image < _EXPOSED[1])).all(2)
        exposed &= True if view.mask is None else view.mask > 0.5
        if exposed.mean() > _LEAST_EXPOSED:
            medians[view.name] = float(np.median(stops[exposed]))
    middle = float(np.median(list(medians.values()))) if medians else 0.0
    return {name: round(value - middle, 2) for name, value in medians.items()}


def high_residual_mask(view: View, exposure: torch.Tensor, response: Response) -> torch.Tensor:
    """Return a [H, W] bool mask of the pixels in regions where a photo differs from the scene's exposure [H, W, 3]."""
    mask = np.zeros(exposure.shape[:2], bool)
    for row, column, _ in _regions(view, exposure, response):
        mask[row, column] = True
    return torch.from_numpy(mask).to(exposure.device)


def _regions(view: View, exposure: torch.Tensor, response: Response) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield rows, columns and stops of the pixels of each region."""
    from scipy import ndimage

    stops, code = _differences(view, exposure, response)
    labels = np.empty(stops.shape, np.int32)
    for sign in (
        1,
        -1,
    ):  # Separately: a region that is partly too bright and partly too dark has a mean difference of 0.
        large = (sign * stops >= MIN_STOPS) & (code >= MIN_CODE_DIFFERENCE)
        ndimage.label(ndimage.binary_opening(large, np.ones((2, 2))), np.ones((3, 3)), output=labels)
        for index, place in enumerate(ndimage.find_objects(labels), start=1):
            row, column = np.nonzero(labels[place] == index)
            if len(row) >= MIN_PIXELS:
                row, column = row + place[0].start, column + place[1].start
                yield row, column, stops[row, column]


def _differences(view: View, exposure: torch.Tensor, response: Response) -> tuple[np.ndarray, np.ndarray]:
    """Return two [H, W] arrays: stops by which the photo is brighter, and the largest difference of encoded values.

    Both are 0 if the photo is clipped and the scene at white, and where a mask excludes the photo.
    """
    photo = torch.from_numpy(view.image).to(exposure.device)
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
