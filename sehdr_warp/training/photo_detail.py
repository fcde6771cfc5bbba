"""The detail of a photo that each Gaussian shows: Gaussians are copied where photos have edges."""

import torch
from torch import Tensor
from torch.nn import functional

from ..model.radiance_field import RadianceField
from .targets import CODE, TrainingView


@torch.no_grad()
def visible_detail(field: RadianceField, view: TrainingView) -> Tensor:
    """Return [N], at least 0: for each Gaussian the sum over pixels of its blending weight times the photo's detail.

    The detail of a pixel is the gradient of the encoded mean of the channels, and one 8-bit code more: where a photo
    has no edges, Gaussians count by the area that they show. Masked pixels have none. The idea is that of Taming 3DGS
    (SIGGRAPH Asia 2024), which scores Gaussians by edges and other terms.

    Args:
        field: The field.
        view: The photo and its camera.
    """
    detail = edges(view.target.encoded)[..., None] + CODE
    if view.target.mask is not None:
        detail = detail * view.target.mask
    return field.weighted_sums(view.camera, detail)[:, 0]


def edges(image: Tensor) -> Tensor:
    """Return the length [H, W] of the gradient of an image's mean over channels, [H, W, 3], by forward differences."""
    grey = image.mean(2)
    across, down = functional.pad(grey.diff(dim=1), (0, 1)), functional.pad(grey.diff(dim=0), (0, 0, 0, 1))
    return torch.hypot(across, down)
