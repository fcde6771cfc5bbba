"""Start Gaussians that photos show as white at the light that is expected of them.

An optimizer moves the logarithm of a color by its learning rate. In short trainings, or for lamps that few photos show,
that is too slow to reach a lamp a hundred times as bright as white from white.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..model.radiance_field import RadianceField
from ..scene import Camera, View
from ..scene.wide_camera import pixels_of_directions
from ..splats.arrays import HARMONIC_0
from ..subsets import every_nth

MOST_VIEWS = 100  # Photos whose estimates are averaged
TOLERANCE = 1e-4  # Of values of the harmonics' constant part that are compared with that of white


@torch.no_grad()
def brighten_clipped(field: RadianceField, views: Sequence[View], estimates: Sequence[Tensor]) -> int:
    """Brighten the Gaussians of a field at iteration 0 that are white, to the light that photos expect there.

    Photos agree by the weights of their estimates, as in the loss. A channel that is not white stays as it is.

    Args:
        field: Its constant colors are those of photos.
        views: Training views, in the field's normalized coordinates.
        estimates: ClippedLight.log_light [h, w, 6] of each view.

    Returns:
        The number of Gaussians that are brighter now.
    """
    gaussians, model = field.gaussians, field.color_model
    values = gaussians.harmonics_dc[:, 0] * HARMONIC_0
    white = torch.from_numpy(model.start(np.ones((1, 3)), field.response)).to(values)
    is_white = values >= white - TOLERANCE
    index = is_white.any(1).nonzero()[:, 0]
    points, sums, weights = gaussians.means[index], 0.0, torch.full((len(index), 3), 1e-12).to(values)
    for view, estimate in every_nth(list(zip(views, estimates, strict=True)), MOST_VIEWS):
        if len(index) and bool(estimate.any()):
            places = _places(view.camera, points)
            inside = ((places >= 0) & (places < 1)).all(1)
            x, y = torch.where(inside[:, None], places, 0).T
            cells = _cells(estimate.to(values), x, y)
            weight = cells[:, 3:].square() * inside[:, None]
            sums = sums + weight * (cells[:, :3] + math.log(field.base_time / view.exposure_time))
            weights += weight
    excess = torch.where(is_white[index], (sums / weights).clamp_min(0), 0)
    gaussians.harmonics_dc[index, 0] = model.brighten(values[index], excess) / HARMONIC_0
    return int((excess > 0).any(1).sum())


def expected_excess(estimate: Tensor, pixels: Tensor, size: tuple[int, int], times: float = 1.0) -> Tensor:
    """Return [N, 3] the logarithm, at least 0, of the expected light over white at a photo's pixels.

    It is 0 where nothing is known. Does not wait for the device.

    Args:
        estimate: ClippedLight.log_light [h, w, 6] of the photo.
        pixels: [N, 2] int64 column and row; others than the photo has count as the nearest.
        size: Width and height of the photo.
        times: The exposure time whose white is meant, over that of the photo.
    """
    x, y = ((pixels[:, axis] + 0.5) / size[axis] for axis in (0, 1))
    light, root = _cells(estimate, x, y).float().split(3, dim=1)
    return torch.where(root > 0, (light + math.log(times)).clamp_min(0), 0)


def _cells(estimates: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return estimates [h, w, C] at places x, y [N] in [0, 1), the nearest beyond."""
    rows, columns = estimates.shape[:2]
    return estimates[(y * rows).long().clamp(0, rows - 1), (x * columns).long().clamp(0, columns - 1)]


def _places(camera: Camera, points: Tensor) -> Tensor:
    """Return where a camera's image shows points [N, 3]: [N, 2] x and y, in [0, 1) within it, or NaN."""
    pose = torch.tensor(camera.world_to_camera).to(points)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    if camera.is_pinhole:
        focal, middle = points.new_tensor([[camera.fx, camera.fy], [camera.cx, camera.cy]])
        pixels = torch.where(local[:, 2:] > 1e-9, local[:, :2] / local[:, 2:] * focal + middle, math.nan)
    else:
        directions = (local / local.norm(dim=1, keepdim=True).clamp_min(1e-12)).cpu().numpy()
        pixels = torch.tensor(pixels_of_directions(directions, camera)[:, ::-1] + 0.5).to(points)
    return pixels / points.new_tensor([camera.width, camera.height])
