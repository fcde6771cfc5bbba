"""Estimates of the light of clipped pixels: the loss pulls light towards them, and they say how sure it is."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ..prior import ClippedLight, coarse_size, combined_estimates, load_prior
from ..response import Response
from ..scene import Camera, View
from ..scene.wide_camera import solid_angles
from .config import LossConfig
from .wide_prior import WidePrior


@torch.no_grad()
def light_estimates(
    views: Sequence[View],
    response: Response | None,
    config: LossConfig,
    device: torch.device,
) -> list[ClippedLight] | None:
    """Return what is known of each view's clipped light, on the CPU.

    None where nothing clips, where the loss does not use it, or where nothing is known. The views are seen by the
    learned prior if config.light_prior is on; light that a photo's file states counts in any case.

    Args:
        views: the training views.
        response: the curve by which exposures are compared; None where they are not.
        config: of the loss.
        device: on which the prior runs.

    Returns:
        What is known of each view. In a training, estimates of panoramas and wide fisheye photos weigh by the solid
        angles of their pixels, relative to the mean, as the rest of the loss does.

    Raises:
        InputError: if the weights of the prior cannot be read.
    """
    if response is None or not config.clipping or config.clipped_estimate == 0:
        return None
    masks = [torch.from_numpy(view.codes >= view.levels) for view in views]
    has_estimate = [config.light_prior or view.light_above_white is not None for view in views]
    if not any(some and bool(mask.any()) for some, mask in zip(has_estimate, masks, strict=True)):
        return None
    prior = load_prior(device) if config.light_prior else None
    result, wide = [], None
    for view, mask in zip(views, masks, strict=True):
        seeing = prior
        if prior is not None and not view.camera.is_pinhole:
            wide = wide if wide is not None and wide.fits(view.camera) else WidePrior(prior, view.camera)
            seeing = wide
        if not bool(mask.any()):
            size = (coarse_size if seeing is None else seeing.size)(*mask.shape[:2])
            nothing = torch.zeros(*size, 6, dtype=torch.float16)
            result.append(ClippedLight(nothing, nothing[..., 3:]))
            continue
        exposure = response.decode(torch.from_numpy(view.image).to(device)).float() / response.white
        stated_light = view.light_above_white
        stated_light = None if stated_light is None else torch.from_numpy(stated_light).to(device).float()
        deviation = view.light_above_white_deviation
        light = combined_estimates(exposure, mask.to(device), seeing, stated_light, deviation)
        result.append(ClippedLight(_by_solid_angle(light.log_light.cpu(), view.camera), light.certainty.cpu()))
    return result


def _by_solid_angle(estimates: Tensor, camera: Camera) -> Tensor:
    """Return estimates [h, w, 6] whose squared weights are multiplied by the solid angles of the camera's pixels."""
    if camera.is_pinhole:
        return estimates
    angles = torch.from_numpy(solid_angles(camera))
    weights = F.interpolate(angles[None, None], size=estimates.shape[:2], mode="area")[0, 0, :, :, None]
    weights = (weights / angles.mean().clamp_min(1e-6)).sqrt()
    return torch.cat([estimates[..., :3], (estimates[..., 3:] * weights).half()], 2)
