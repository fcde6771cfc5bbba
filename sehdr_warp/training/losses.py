"""The loss of a training step: photos against renders, HDR truth against exposures."""

import torch
from torch import Tensor

from ..model.gaussians import Gaussians
from ..model.radiance_field import RadianceField
from ..model.renders import PhotoRender
from ..rasterizer.losses.code_residual import code_residual
from ..rasterizer.losses.opacity_penalty import opacity_penalty
from ..rasterizer.losses.photo_loss import ClippedWeights, clipped_light_energy, photo_loss
from ..rasterizer.losses.ssim import image_distance, ssim
from ..response import Response, ToneMapper
from ..runs.config import LossConfig
from .targets import Target, mu_law

ANCHOR = 0.5  # Encoded value of the unit exposure that anchor_loss aims at: the middle of the range
MAX_LOG_SIZE = 20.0  # Sizes above e ** MAX_LOG_SIZE count as that, so that size_loss stays finite


def image_loss(prediction: Tensor, truth: Tensor, mask: Tensor | None, form: str, weight: float) -> Tensor:
    """Return the loss between two images [H, W, 3]; pixels outside of the mask [H, W, 1] do not count.

    Args:
        prediction: Rendered image.
        truth: Reference.
        mask: Weights in [0, 1]; SSIM sees masked pixels as equal.
        form: "sum": L1 + weight (1 - SSIM) (SeHDR, equation 16); "blend": (1 - weight) L1 + weight (1 - SSIM) (3DGS).
        weight: Weight of SSIM.
    """
    distance_weight = _distance_weight(form, weight)
    if mask is None and weight:
        return image_distance(prediction, truth, distance_weight, weight)
    if mask is None:
        return (prediction - truth).abs().mean()
    prediction, truth = prediction * mask, truth * mask
    difference = distance_weight * (prediction - truth).abs().mean() / mask.mean().clamp_min(1e-6)
    return difference + weight * (1 - ssim(prediction, truth)) if weight else difference


def _distance_weight(form: str, weight: float) -> float:
    """Return the weight of L1."""
    return 1.0 if form == "sum" else 1 - weight


def ldr_loss(render: PhotoRender, target: Target, config: LossConfig) -> Tensor:
    """Return L_LDR on the target's scale.

    If exposures are compared, the light of clipped pixels, which the photo does not determine, is smoothed and held at
    estimates.
    """
    image = compared_image(render, target)
    codes, scale, index, weight = target.codes, target.scale, target.index, config.ssim_weight
    smooths_clipped = scale.compares_exposures and config.clipping
    estimate_weight = 0.0 if target.estimates is None else config.clipped_estimate
    clipped = ClippedWeights(config.clipped_smoothness, estimate_weight) if smooths_clipped else ClippedWeights()
    if target.mask is None and weight:
        # The common case: the terms below in one launch, and with one gradient.
        return photo_loss(
            image,
            codes,
            scale,
            index,
            distance_weight=_distance_weight(config.form, weight),
            dissimilarity_weight=weight,
            clipped=clipped,
            estimates=target.estimates,
        )
    prediction, truth = code_residual(image, codes, scale, index)
    loss = image_loss(prediction, truth, target.mask, config.form, weight)
    if clipped:
        loss = loss + clipped_light_energy(image, codes, scale.white, clipped, index, target.mask, target.estimates)
    return loss


def compared_image(render: PhotoRender, target: Target) -> Tensor:
    """Return the image that is compared with the photo: exposures if the target has them, else encoded values."""
    image = render.photo_exposure if target.scale.compares_exposures else render.encoded
    assert image is not None
    return image


def comparing_response(config: LossConfig, field: RadianceField) -> Response | None:
    """Return the known response by which ldr_loss compares exposures; None if it compares encoded values or nothing."""
    decodable = not field.color_model.display_referred and field.tone_map == "pixel" and not field.response.learnable
    return field.response if config.ldr_weight > 0 and decodable else None


def anchor_loss(mapper: ToneMapper) -> Tensor:
    """Return the mean over channels of (f(1) - ANCHOR)^2.

    Photos of one exposure do not determine the scale of a learned f, which drifts without this term. Source: the unit
    exposure loss of HDR-NeRF (CVPR 2022).
    """
    return (mapper.encode_log(mapper.weights[0].new_zeros(1, 3)) - ANCHOR).square().mean()


def linear_loss(render: PhotoRender, target: Target, config: LossConfig) -> Tensor | None:
    """Return L_linear (SeHDR, equation 19): base exposure against HDR truth or the fused exposure; None without one."""
    truth = target.exposure_truth if config.hdr_truth else None
    if truth is None and render.base is render.exposure:
        return None
    assert render.base is not None
    if truth is None:
        assert render.exposure is not None
        # Detached, so that the base follows the fused exposure; else both would drift to a trivial agreement.
        truth = render.exposure.detach()
    return image_loss(render.base, truth, target.mask, config.form, config.ssim_weight)


def hdr_loss(render: PhotoRender, target: Target, config: LossConfig, largest: float) -> Tensor:
    """Return the loss of the HDR color's exposure against HDR truth in the mu-law.

    Both are divided by the largest truth of all views. HDR-GS divides each image by its own maximum, which leaves the
    scale of the scene undetermined.
    """
    assert render.exposure is not None and target.exposure_truth is not None
    prediction, truth = (mu_law(image / largest, 1.0) for image in (render.exposure, target.exposure_truth))
    return image_loss(prediction, truth, target.mask, config.form, config.ssim_weight)


def extra_images(config: LossConfig, has_truth: bool) -> frozenset[str]:
    """Return the extra images that render_photo() must render for data_loss."""
    images = {"exposure"} if config.hdr_weight > 0 and has_truth else set()
    if config.linear_weight > 0:
        images |= {"base"} if config.hdr_truth and has_truth else {"base", "exposure"}
    return frozenset(images)


def data_loss(
    field: RadianceField, render: PhotoRender, target: Target, config: LossConfig, largest_truth: float = 1.0
) -> Tensor:
    """Return L_LDR + beta L_linear (SeHDR, equation 20) + HDR loss + anchor, each if it has a weight."""
    loss = ldr_loss(render, target, config) if config.ldr_weight > 0 else 0.0
    if config.ldr_weight not in (0, 1):
        loss = config.ldr_weight * loss
    if config.hdr_weight > 0 and target.exposure_truth is not None:
        loss = loss + config.hdr_weight * hdr_loss(render, target, config, largest_truth)
    if config.linear_weight > 0:
        linear = linear_loss(render, target, config)
        loss = loss if linear is None else loss + config.linear_weight * linear
    if config.anchor_weight > 0 and isinstance(field.response, ToneMapper):
        loss = loss + config.anchor_weight * anchor_loss(field.response)
    assert isinstance(loss, Tensor), "a config without any loss is refused"
    return loss


def opacity_loss(field: RadianceField, render: PhotoRender, weight: float, moments: Tensor | None = None) -> Tensor:
    """Return `weight` times the mean opacity of the Gaussians.

    With Adam's second moments [N] of the opacities, those that no photo has shown yet do not count.
    """
    assert render.opacities is not None
    extents = None if moments is None else render.rendering.extents
    return opacity_penalty(render.opacities, extents, moments, weight, field.gaussians.active_count)


def transmittance_loss(render: PhotoRender, target: Target, weight: float) -> Tensor:
    """Return `weight` times the mean transmittance of the pixels that the photo's mask keeps.

    Black is behind the Gaussians, so a surface that lets through a tenth of it fits a photo as well as an opaque one
    that is a tenth darker. Such a surface is too bright where several overlap in other directions, and over pictures.
    """
    transmittance, mask = render.rendering.transmittance, target.mask
    if mask is None:
        return weight * transmittance.mean()
    return weight * (transmittance * mask[..., 0]).mean() / mask.mean().clamp_min(1e-6)


def size_loss(gaussians: Gaussians, weight: float) -> Tensor:
    """Return `weight` times the mean of all standard deviations, in units of the normalized world.

    Adam moves a parameter by about its rate however small its gradient is. So a small weight shrinks the Gaussians that
    no photo supports, and hardly changes the others. Source: 3DGS-MCMC (NeurIPS 2024), equation 10.
    """
    sizes = gaussians.log_scales.clamp_max(MAX_LOG_SIZE).exp()
    if gaussians.active_count is None:
        return weight * sizes.mean()
    is_active = torch.arange(len(sizes), device=sizes.device) < gaussians.active_count
    return weight * (sizes * is_active[:, None]).sum() / (3 * gaussians.active_count[0])
