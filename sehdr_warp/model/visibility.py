"""Measure where cameras show each Gaussian of a scene: in how many views, how much of it, and inside of masks."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..scene import Camera, View
from ..scene.wide_camera import painted_mask
from ..subsets import every_nth
from .radiance_field import RadianceField

VIEW_SIZE = 320  # Longest side, in pixels, of the views that are counted
LEAST_WEIGHT = 0.05  # Sum of blending weights, in pixels of such a view, with which it shows a Gaussian
MOST_VIEWS = 100


@torch.no_grad()
def count_views(field: RadianceField, cameras: Sequence[Camera]) -> Tensor:
    """Return [N], the number of cameras that show each Gaussian; a Gaussian hidden behind others is not shown.

    Of the cameras, in scene coordinates, at most MOST_VIEWS are rendered, evenly chosen; their count is scaled to all.
    """
    subset = every_nth(cameras, MOST_VIEWS)
    views = torch.zeros(field.gaussians.count, device=field.gaussians.means.device)
    for camera in subset:
        views += blending_weights(field, camera.within(VIEW_SIZE)) > LEAST_WEIGHT
    return views * (len(cameras) / len(subset))


@torch.no_grad()
def contributions(field: RadianceField, cameras: Sequence[Camera]) -> Tensor:
    """Return [N], the sum of each Gaussian's blending weights over cameras, pixels; arguments as in count_views."""
    total = torch.zeros(field.gaussians.count, device=field.gaussians.means.device)
    for camera in every_nth(cameras, MOST_VIEWS):
        total += blending_weights(field, camera.within(VIEW_SIZE))
    return total


@torch.no_grad()
def mask_shares(field: RadianceField, views: Sequence[View]) -> Tensor:
    """Return [N], the share of each Gaussian's blending weights that the masks of views, in scene coordinates, keep.

    It is 0 if no view shows the Gaussian. A view without a mask keeps everything.
    """
    device = field.gaussians.means.device
    sums = torch.zeros((field.gaussians.count, 2), device=device)
    for view in every_nth(views, MOST_VIEWS):
        small = view.camera.within(VIEW_SIZE)
        painted = painted_mask(view)
        painted = np.ones((view.camera.height, view.camera.width)) if painted is None else painted
        mask = torch.as_tensor(painted, dtype=torch.float32, device=device)[None, None]
        mask = torch.nn.functional.interpolate(mask, (small.height, small.width), mode="area")[0, 0]
        images = torch.stack([torch.ones_like(mask), mask], dim=2)
        sums += field.weighted_sums(field.camera_tensors(small), images)
    return torch.where(sums[:, 0] > LEAST_WEIGHT, sums[:, 1] / sums[:, 0].clamp_min(LEAST_WEIGHT), 0.0)


def blending_weights(field: RadianceField, camera: Camera, mask: np.ndarray | None = None) -> Tensor:
    """Return [N], the sum of each Gaussian's blending weights in a picture of a camera inside a mask [H, W], pixels."""
    device = field.gaussians.means.device
    weight = torch.ones(camera.height, camera.width, device=device)
    if mask is not None:
        weight = torch.tensor(mask, device=device)
    # Three channels like a training's features, so that no further kernel is compiled.
    images = weight[..., None].expand(-1, -1, 3).contiguous()
    return field.weighted_sums(field.camera_tensors(camera), images)[:, 0]
