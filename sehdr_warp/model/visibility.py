"""Count the cameras that show each Gaussian of a scene."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..scene import Camera
from .camera_tensors import CameraTensors
from .radiance_field import RadianceField

VIEW_SIZE = 320  # Longest side, in pixels, of the views that are counted
LEAST_WEIGHT = 0.05  # Sum of blending weights, in pixels of such a view, with which it shows a Gaussian
MOST_VIEWS = 100


@torch.no_grad()
def count_views(field: RadianceField, cameras: Sequence[Camera]) -> Tensor:
    """Return [N], the number of cameras that show each Gaussian; a Gaussian hidden behind others is not shown.

    At most MOST_VIEWS cameras are rendered, evenly chosen, and their count is scaled to all of them.

    Args:
        field: The scene.
        cameras: At least one.
    """
    device = field.gaussians.means.device
    subset = cameras[:: -(-len(cameras) // MOST_VIEWS)]
    views = torch.zeros(field.gaussians.count, device=device)
    for camera in subset:
        small = camera.within(VIEW_SIZE)
        ones = torch.ones((small.height, small.width, 3), device=device)
        views += field.weighted_sums(CameraTensors.of(small, device), ones)[:, 0] > LEAST_WEIGHT
    return views * (len(cameras) / len(subset))
