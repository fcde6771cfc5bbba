"""What a training minimises: photos against photos, exposures against exposures."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.radiance_field import Photograph, RadianceField
from ..splatting.ssim import ssim
from .config import LossConfig

CODE = 1 / 255
"""One step of an 8-bit photo."""


@dataclass(frozen=True)
class Target:
    """One training photo on the device, at one resolution.

    encoded: [H, W, 3] in [0, 1]; clipped, black: [H, W, 3] bool, or None where the photo has none of them;
    mask: [H, W, 1] in [0, 1] or None; exposure_truth: [H, W, 3] true radiance times the base time, or None.
    """

    encoded: Tensor
    clipped: Tensor | None
    black: Tensor | None
    mask: Tensor | None
    exposure_truth: Tensor | None


def one_sided(prediction: Tensor, target: Target) -> Tensor:
    """The prediction [H, W, 3] as far as the photo can tell. A clipped pixel says `at least white less half a code`, so
    what is brighter equals it: without the half code a response that never quite reaches white would be pulled up for
    ever. A black pixel says `at most half a code`, so what is darker equals it."""
    if target.clipped is not None:
        reached = torch.minimum(prediction + CODE / 2, target.encoded)
        prediction = torch.where(target.clipped, reached, prediction)
    if target.black is not None:
        prediction = torch.where(target.black, (prediction - CODE / 2).clamp_min(0), prediction)
    return prediction


def image_loss(prediction: Tensor, truth: Tensor, mask: Tensor | None, form: str, weight: float) -> Tensor:
    """L1 + weight (1 - SSIM) ("sum", SeHDR's equation 11) or (1 - weight) L1 + weight (1 - SSIM) ("blend", 3DGS).

    prediction, truth: [H, W, 3]; mask: [H, W, 1] or None: pixels outside count nothing in L1 and as equal in SSIM.
    """
    if mask is not None:
        prediction, truth = prediction * mask, truth * mask
    difference = (prediction - truth).abs().mean()
    if mask is not None:
        difference = difference / mask.mean().clamp_min(1e-6)
    if weight == 0:
        return difference
    dissimilarity = 1 - ssim(prediction, truth)
    return (difference if form == "sum" else (1 - weight) * difference) + weight * dissimilarity


def ldr_loss(photo: Photograph, target: Target, config: LossConfig) -> Tensor:
    """The photo against the simulated one; with `clipping`, one-sided where the camera saturated (L_LDR)."""
    prediction = one_sided(photo.encoded, target) if config.clipping else photo.encoded
    return image_loss(prediction, target.encoded, target.mask, config.form, config.ssim_weight)


def linear_loss(photo: Photograph, target: Target, config: LossConfig) -> Tensor | None:
    """SeHDR's L_linear: base exposure against true exposure where there is truth (and hdr_truth is on), else against
    the fused one; None where there is nothing to compare."""
    if config.hdr_truth and target.exposure_truth is not None:
        return image_loss(photo.base, target.exposure_truth, target.mask, config.form, config.ssim_weight)
    if photo.base is photo.exposure:
        return None
    base, fused = photo.base, photo.exposure
    if config.linear_detach == "fused":
        fused = fused.detach()
    elif config.linear_detach == "base":
        base = base.detach()
    return image_loss(base, fused, target.mask, config.form, config.ssim_weight)


def total_loss(field: RadianceField, photo: Photograph, target: Target, config: LossConfig) -> Tensor:
    """L_LDR + beta L_linear (equation 13), and the regularisers of 3DGS-MCMC where they have a weight."""
    loss = ldr_loss(photo, target, config)
    if config.linear_weight > 0:
        linear = linear_loss(photo, target, config)
        loss = loss if linear is None else loss + config.linear_weight * linear
    if config.opacity_weight > 0:
        loss = loss + config.opacity_weight * field.gaussians.opacities().mean()
    if config.scale_weight > 0:
        loss = loss + config.scale_weight * field.gaussians.log_scales.exp().mean()
    return loss
