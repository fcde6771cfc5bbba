"""The loss of a training step: photos against renders, HDR truth against exposures."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.radiance_field import RadianceField
from ..model.renders import TrainRender
from ..rasterizer.activations import opacity_penalty
from ..rasterizer.code_residual import CodeScale, code_residual, code_values
from ..rasterizer.photo_loss import ClippedWeights, clipped_light_energy, photo_loss
from ..rasterizer.ssim import image_distance, ssim
from ..response import Response, ToneMapper
from ..runs.config import LossConfig

CODE = 1 / 255  # One step of an 8-bit photo
MU = 5000.0  # Parameter of the mu-law in which HDR images are compared
KNEE = 8.0  # Code of 255 above black at white / mu in the mu-law of photos, linear below and logarithmic above
GAIN_MAP_KNEE = 0.5  # The same exposure, where codes hold four stops more
INTERVALS_FROM = 0.85
"""Fraction of a training after which bright codes are intervals. From the start, clipped light would have fewer pixels
around it that determine it."""
ANCHOR = 0.5  # Encoded value of the unit exposure that anchor_loss aims at: the middle of the range


@dataclass(frozen=True)
class Target:
    """One training photo on the device.

    Attributes:
        codes: [H, W, 3] as from code_tensor(); or, with an index, a stack [V, H, W, 3] that contains the photo.
        scale: Values and intervals that the codes stand for.
        mask: [H, W, 1] in [0, 1].
        exposure_truth: [H, W, 3] radiance of HDR truth times the base time.
        estimates: Estimates of the light of clipped pixels, as in clipped_light_energy().
        index: [1] int64, position of the photo in the stack.
    """

    codes: Tensor
    scale: CodeScale
    mask: Tensor | None = None
    exposure_truth: Tensor | None = None
    index: Tensor | None = None
    estimates: Tensor | None = None

    @property
    def encoded(self) -> Tensor:
        """Encoded values [H, W, 3] in [0, 1], computed from the codes at each access."""
        return code_values(select_view(self.codes, self.index))

    def psnr(self, encoded: Tensor) -> float:
        """Return the PSNR of encoded values [H, W, 3] against the photo inside the mask, dB."""
        squared = (encoded.clamp(0, 1) - self.encoded).square().mean(2, keepdim=True)
        weights = torch.ones_like(squared) if self.mask is None else self.mask
        mean = (squared * weights).sum() / weights.sum().clamp_min(1e-6)
        return float(-10 * mean.clamp_min(1e-10).log10())


def select_view(stack: Tensor, index: Tensor | None) -> Tensor:
    """Return a copy of element index [1] of a stack [V, ...], on its device; without an index the tensor itself."""
    return stack if index is None else stack.index_select(0, index)[0]


def code_scale(
    largest: int, response: Response | None, device, *, clipping: bool = True, dtype: torch.dtype = torch.float32
) -> CodeScale:
    """Return how photos are compared: in the mu-law of decoded exposures, or without a response as encoded values.

    With `clipping`, white means at least white less half an 8-bit code, and 0 at most half a code. The half code, for
    16 bits too, keeps a response that never quite reaches white from being pulled up.

    If exposures are compared, a code stands for the middle of the interval of exposures that round to it. Near white
    an interval may span stops. CodeScale.widen() makes all of it equally good, less the finest 8-bit step at its ends,
    so that codes with finer intervals stay values.

    Args:
        largest: Largest code, 255 or 65535.
        response: Response that decodes the codes; None to compare encoded values.
        device: Torch device of the tables.
        clipping: Treat the smallest and the largest code as intervals.
        dtype: Type of the tables.
    """
    mu, white = (0.0, 1.0) if response is None else (mu_of_knee(response), response.white)

    def to_scale(encoded: Tensor) -> Tensor:
        return encoded if response is None else mu_law(response.decode(encoded), white, mu)

    values = torch.arange(largest + 1, dtype=torch.float64) / largest
    centers, between = to_scale(values), to_scale(values[:-1] + 0.5 / largest)
    if response is not None:
        centers[1:-1] = (between[1:] + between[:-1]) / 2
    table, wide = torch.stack([centers, centers, centers], 1), None
    if clipping:
        table[0, 1], table[-1, 2] = -math.inf, math.inf
        table[0, 2], table[-1, 1] = to_scale(values.new_tensor([CODE / 2, 1 - CODE / 2]))
        if response is not None:
            finest = to_scale((torch.arange(255) + 0.5).double() / 255).diff().min()
            ends = torch.stack([between[:-1] + finest, between[1:] - finest], 1)
            wide = table.clone()
            wide[1:-1, 1:] = torch.where(ends[:, :1] < ends[:, 1:], ends, table[1:-1, 1:])
            wide = wide.to(device, dtype)
    return CodeScale(table.to(device, dtype), mu, white, wide)


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


def ldr_loss(render: TrainRender, target: Target, config: LossConfig) -> Tensor:
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


def compared_image(render: TrainRender, target: Target) -> Tensor:
    """Return the image that is compared with the photo: exposures if the target has them, else encoded values."""
    image = render.photo_exposure if target.scale.compares_exposures else render.encoded
    assert image is not None
    return image


def compares_exposures(config: LossConfig, field: RadianceField) -> bool:
    """Return whether ldr_loss compares exposures: if each pixel has one and the response is known."""
    decodable = not field.color_model.encoded and field.tone_map == "pixel" and not field.response.learnable
    return config.ldr_weight > 0 and decodable


def mu_of_knee(response: Response) -> float:
    """Return the mu whose knee, white / mu, is the exposure of code KNEE of 255 above black, for any response.

    Log curves have black at a tenth of their codes and more.
    """
    knee = GAIN_MAP_KNEE if response.name == "gain-map" else KNEE
    return response.white / max(float(response.decode(float(response.black) + knee / 255)), 1e-12)


def mu_law(exposure: Tensor, white: float, mu: float = MU) -> Tensor:
    """Return log(1 + mu x / white) / log(1 + mu): 0 for no light, 1 for the exposure that photos show as white."""
    return torch.log1p(exposure * (mu / white)) / math.log1p(mu)


def anchor_loss(mapper: ToneMapper) -> Tensor:
    """Return the mean over channels of (f(1) - ANCHOR)^2.

    Photos of one exposure do not determine the scale of a learned f, which drifts without this term. Source: the unit
    exposure loss of HDR-NeRF (CVPR 2022).
    """
    return (mapper.encode_log(mapper.weights[0].new_zeros(1, 3)) - ANCHOR).square().mean()


def linear_loss(render: TrainRender, target: Target, config: LossConfig) -> Tensor | None:
    """Return SeHDR's L_linear: base exposure against HDR truth or the fused exposure; None without a reference."""
    truth = target.exposure_truth if config.hdr_truth else None
    if truth is None and render.base is render.exposure:
        return None
    assert render.base is not None
    if truth is None:
        assert render.exposure is not None
        # Detached, so that the base follows the fused exposure; else both would drift to a trivial agreement.
        truth = render.exposure.detach()
    return image_loss(render.base, truth, target.mask, config.form, config.ssim_weight)


def hdr_loss(render: TrainRender, target: Target, config: LossConfig, largest: float) -> Tensor:
    """Return the loss of the HDR color's exposure against HDR truth in the mu-law.

    Both are divided by the largest truth of all views. HDR-GS divides each image by its own maximum, which leaves the
    scale of the scene undetermined.
    """
    assert render.exposure is not None and target.exposure_truth is not None
    prediction, truth = (mu_law(image / largest, 1.0) for image in (render.exposure, target.exposure_truth))
    return image_loss(prediction, truth, target.mask, config.form, config.ssim_weight)


def extra_images(config: LossConfig, has_truth: bool) -> frozenset[str]:
    """Return the extra images that render_train_view() must render for data_loss."""
    images = {"exposure"} if config.hdr_weight > 0 and has_truth else set()
    if config.linear_weight > 0:
        images |= {"base"} if config.hdr_truth and has_truth else {"base", "exposure"}
    return frozenset(images)


def data_loss(
    field: RadianceField, render: TrainRender, target: Target, config: LossConfig, largest_truth: float = 1.0
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


def opacity_loss(field: RadianceField, render: TrainRender, weight: float, moments: Tensor | None = None) -> Tensor:
    """Return `weight` times the mean opacity of the Gaussians.

    With Adam's second moments [N] of the opacities, those that no photo has shown yet do not count.
    """
    assert render.opacities is not None
    extents = None if moments is None else render.rendering.extents
    return opacity_penalty(render.opacities, extents, moments, weight, field.gaussians.active_count)
