"""What photos show and a trained scene does not: regions whose light is off by a stop and more."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch

from ..response import Response
from ..response.curve import HALF_CODE
from ..scene import View
from .radiance_field import RadianceField

LEAST_STOPS, LEAST_CODE = 1.0, 0.1  # A pixel is off by both: noise is stops in the dark, and little light in the bright
LEAST_PIXELS = 6
MOST_NAMED = 20
MOST_VIEWS = 200  # Training views that are looked at, evenly chosen: more change the means little


@dataclass(frozen=True)
class Region:
    """photo: the view's name. column, row: of the region's middle; pixels: its area; at the size of training. stops: by
    how much the photo is brighter than the scene, in the mean; where either is clipped or black, at least. box: left,
    top, width and height around it."""

    photo: str
    column: float
    row: float
    pixels: int
    stops: float
    box: tuple[int, int, int, int]


@torch.no_grad()
def unexplained_regions(field: RadianceField, views: Sequence[View], *, degree: int | None = None) -> list[Region]:
    """Of up to 200 photos, evenly chosen, the regions of LEAST_PIXELS and more that a field shows otherwise, the worst
    first: by area times stops. Lines a pixel wide, as edges leave them, are none."""
    found = []
    for view in views[:: -(-len(views) // MOST_VIEWS) or 1]:
        exposure = field.render(view.camera, degree=degree).hdr * view.exposure_time
        for row, column, stops in _regions(view, exposure, field.response):
            left, top = int(column.min()), int(row.min())
            middle = round(float(column.mean()) + 0.5, 1), round(float(row.mean()) + 0.5, 1)
            box = left, top, int(column.max()) - left + 1, int(row.max()) - top + 1
            found.append(Region(view.name, *middle, len(row), round(float(stops.mean()), 2), box))
    return sorted(found, key=lambda region: -region.pixels * abs(region.stops))


def unexplained_pixels(view: View, exposure: torch.Tensor, response: Response) -> torch.Tensor:
    """[H, W] bool: those of the regions that a photo shows otherwise than exposure [H, W, 3]."""
    inside = np.zeros(exposure.shape[:2], bool)
    for row, column, _ in _regions(view, exposure, response):
        inside[row, column] = True
    return torch.from_numpy(inside).to(exposure.device)


def _regions(view: View, exposure: torch.Tensor, response: Response) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows, columns and stops of the pixels of each region."""
    from scipy import ndimage

    stops, code = _differences(view, exposure, response)
    labels = np.empty(stops.shape, np.int32)
    for sign in (1, -1):  # Apart: what is too bright beside what is too dark would be off by nothing in the mean
        off = (sign * stops >= LEAST_STOPS) & (code >= LEAST_CODE)
        ndimage.label(ndimage.binary_opening(off, np.ones((2, 2))), np.ones((3, 3)), output=labels)
        for index, place in enumerate(ndimage.find_objects(labels), start=1):
            row, column = np.nonzero(labels[place] == index)
            if len(row) >= LEAST_PIXELS:
                row, column = row + place[0].start, column + place[1].start
                yield row, column, stops[row, column]


def _differences(view: View, exposure: torch.Tensor, response: Response) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] stops by which the photo is brighter, of the channels' mean, and the largest difference of encoded values;
    none where the photo is clipped and the scene at white, or the photo does not count."""
    photo = torch.from_numpy(view.image).to(exposure.device)
    shown = response.encode_extended(exposure).clamp(0, 1)
    # Below half a code two exposures are the same to the photo.
    light = [response.decode(encoded.clamp_min(HALF_CODE)).mean(2) for encoded in (photo, shown)]
    stops, code = (light[0] / light[1]).log2(), (photo - shown).abs().amax(2)
    counted = 1.0 if view.mask is None else view.mask > 0.5
    return stops.cpu().numpy() * counted, code.cpu().numpy()


def told(regions: Sequence[Region]) -> dict:
    """Plain values for summary.json: counts, and the worst regions."""
    photos = len({region.photo for region in regions})
    return {"regions": len(regions), "photos": photos, "worst": [asdict(region) for region in regions[:MOST_NAMED]]}
