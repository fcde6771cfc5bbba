"""What a training minimises: photos against photos, exposures against exposures."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.radiance_field import RadianceField, TrainRender
from ..rasterizer.clipped_light import ClippedWeights, clipped_light_energy
from ..rasterizer.code_residual import CodeScale, code_residual, code_values
from ..rasterizer.photo_loss import photo_loss
from ..rasterizer.ssim import image_distance, ssim
from ..response import Response, ToneMapper
from ..runs.config import LossConfig

CODE = 1 / 255  # One step of an 8-bit photo
MU = 5000.0  # Of the mu-law in which HDR images are compared
KNEE = 8.0  # The code of 255 at white / mu in the mu-law of photos: light below counts as light, above as its logarithm
INTERVALS_FROM = 0.85
"""Of a training, the part after which codes that stand for much light are intervals: where they were from the start,
clipped light would have fewer pixels around it that hold it."""
ANCHOR = 0.5  # What anchor_loss wants the unit exposure encoded as: the middle of the encoded range


@dataclass(frozen=True)
class Target:
    """One training photo on the device.

    codes: [H, W, 3] as code_tensor() holds them; or with an index [1], int64, a stack [V, H, W, 3] that has the photo
    there. scale: what they are worth. mask: [H, W, 1] in [0, 1]. exposure_truth: [H, W, 3] radiance times base time.
    estimates: of the light of clipped pixels, as clipped_light_energy() takes them.
    """

    codes: Tensor
    scale: CodeScale
    mask: Tensor | None = None
    exposure_truth: Tensor | None = None
    index: Tensor | None = None
    estimates: Tensor | None = None

    @property
    def encoded(self) -> Tensor:
        """[H, W, 3] in [0, 1], made of the codes whenever it is asked for."""
        return code_values(one_of(self.codes, self.index))

    def psnr(self, encoded: Tensor) -> float:
        """dB, of encoded values [H, W, 3] against the photo, where the mask counts."""
        squared = (encoded.clamp(0, 1) - self.encoded).square().mean(2, keepdim=True)
        weights = torch.ones_like(squared) if self.mask is None else self.mask
        mean = (squared * weights).sum() / weights.sum().clamp_min(1e-6)
        return float(-10 * mean.clamp_min(1e-10).log10())


def one_of(stack: Tensor, index: Tensor | None) -> Tensor:
    """A copy of the one of a stack [V, ...] that is at index [1], on its device; without an index the tensor itself."""
    return stack if index is None else stack.index_select(0, index)[0]


def code_scale(
    largest: int, response: Response | None, device, *, clipping: bool = True, dtype: torch.dtype = torch.float32
) -> CodeScale:
    """How photos are compared: in the mu-law of the exposures that the response decodes, or without one as encoded.

    largest: code, 255 or 65535. clipping: it says `at least white less half a code`, and 0 says `at most half a code`;
    the half, of 8 bits for 16 too, keeps a response that never quite reaches white from being pulled up. Of exposures a
    code is worth the middle of what it stands for, which near white may be stops of light: with clipping, an exposure
    anywhere within is as good once the scale is widened, but for the finest step of 8 bits at its ends: fine codes stay
    values.
    """
    mu, white = (0.0, 1.0) if response is None else (mu_of_knee(response), response.white)

    def compared(encoded: Tensor) -> Tensor:
        return encoded if response is None else mu_law(response.decode(encoded), white, mu)

    values = torch.arange(largest + 1, dtype=torch.float64) / largest
    worth, between = compared(values), compared(values[:-1] + 0.5 / largest)
    if response is not None:
        worth[1:-1] = (between[1:] + between[:-1]) / 2
    table, wide = torch.stack([worth, worth, worth], 1), None
    if clipping:
        table[0, 1], table[-1, 2] = -math.inf, math.inf
        table[0, 2], table[-1, 1] = compared(values.new_tensor([CODE / 2, 1 - CODE / 2]))
        if response is not None:
            finest = compared((torch.arange(255) + 0.5).double() / 255).diff().min()
            ends = torch.stack([between[:-1] + finest, between[1:] - finest], 1)
            wide = table.clone()
            wide[1:-1, 1:] = torch.where(ends[:, :1] < ends[:, 1:], ends, table[1:-1, 1:])
            wide = wide.to(device, dtype)
    return CodeScale(table.to(device, dtype), mu, white, wide)


def image_loss(prediction: Tensor, truth: Tensor, mask: Tensor | None, form: str, weight: float) -> Tensor:
    """L1 + weight (1 - SSIM) ("sum", SeHDR's equation 11) or (1 - weight) L1 + weight (1 - SSIM) ("blend", 3DGS), of
    [H, W, 3]; pixels outside of the mask [H, W, 1] count nothing in L1 and as equal in SSIM."""
    distance_weight = _distance_weight(form, weight)
    if mask is None and weight:
        return image_distance(prediction, truth, distance_weight, weight)
    if mask is None:
        return (prediction - truth).abs().mean()
    prediction, truth = prediction * mask, truth * mask
    difference = distance_weight * (prediction - truth).abs().mean() / mask.mean().clamp_min(1e-6)
    return difference + weight * (1 - ssim(prediction, truth)) if weight else difference


def _distance_weight(form: str, weight: float) -> float:
    return 1.0 if form == "sum" else 1 - weight


def ldr_loss(photo: TrainRender, target: Target, config: LossConfig) -> Tensor:
    """L_LDR, on the target's scale, as far as the photo can tell; where exposures are compared, the light of clipped
    pixels, which it does not tell, is as smooth as it can be."""
    image = photo.light if target.scale.mu else photo.encoded
    assert image is not None
    codes, scale, index, weight = target.codes, target.scale, target.index, config.ssim_weight
    clipped = clipped_weights(config, target) if target.scale.mu and config.clipping else ClippedWeights()
    if target.mask is None and weight:
        weights = {"distance_weight": _distance_weight(config.form, weight), "dissimilarity_weight": weight}
        return photo_loss(image, codes, scale, index, **weights, clipped=clipped, estimates=target.estimates)
    seen, truth = code_residual(image, codes, scale, index)
    loss = image_loss(seen, truth, target.mask, config.form, weight)
    if clipped:
        loss = loss + clipped_light_energy(image, codes, scale.white, clipped, index, target.mask, target.estimates)
    return loss


def clipped_weights(config: LossConfig, target: Target) -> ClippedWeights:
    """Return the weights of the parts of a loss that shape clipped light; without estimates nothing holds it."""
    hold = 0.0 if target.estimates is None else config.clipped_estimate
    return ClippedWeights(config.clipped_smoothness, config.clipped_lift, hold)


def compares_light(config: LossConfig, field: RadianceField) -> bool:
    """Whether ldr_loss compares exposures: where pixels have one and the curve is known."""
    decodable = not field.color_model.encoded and field.tone_map == "pixel" and not field.response.learnable
    return config.ldr_weight > 0 and decodable


def mu_of_knee(response: Response) -> float:
    """The mu whose knee, white / mu, is the exposure of code KNEE of 255, for any curve."""
    return response.white / max(float(response.decode(KNEE / 255)), 1e-12)


def mu_law(exposure: Tensor, white: float, mu: float = MU) -> Tensor:
    """log(1 + mu x / white) / log(1 + mu): 0 for no light, 1 for the exposure that photos show as white."""
    return torch.log1p(exposure * (mu / white)) / math.log1p(mu)


def anchor_loss(mapper: ToneMapper) -> Tensor:
    """Mean over channels of (f(1) - ANCHOR)^2: photos of one exposure leave a learned f's scale open, and it drifts.
    Source: the unit exposure loss of HDR-NeRF (CVPR 2022)."""
    return (mapper.encode_log(mapper.weights[0].new_zeros(1, 3)) - ANCHOR).square().mean()


def linear_loss(photo: TrainRender, target: Target, config: LossConfig) -> Tensor | None:
    """SeHDR's L_linear: base exposure against the true one where hdr_truth is on and there is any, else against the
    fused one; None where there is nothing to compare."""
    truth = target.exposure_truth if config.hdr_truth else None
    if truth is None and photo.base is photo.exposure:
        return None
    assert photo.base is not None
    if truth is None:
        assert photo.exposure is not None
        # The base follows: without the detached side both would settle on what is easiest to agree on.
        truth = photo.exposure.detach()
    return image_loss(photo.base, truth, target.mask, config.form, config.ssim_weight)


def hdr_loss(photo: TrainRender, target: Target, config: LossConfig, largest: float) -> Tensor:
    """The HDR color's exposure against the true one, both divided by the greatest of all views, in the mu-law. HDR-GS
    divides each image by its own maximum, and with that leaves the scale of the scene open."""
    assert photo.exposure is not None and target.exposure_truth is not None
    shown, truth = (mu_law(image / largest, 1.0) for image in (photo.exposure, target.exposure_truth))
    return image_loss(shown, truth, target.mask, config.form, config.ssim_weight)


def needed_colours(config: LossConfig, has_truth: bool) -> frozenset[str]:
    """What render_train_view() must render besides the photo for data_loss of a view with or without HDR truth."""
    wanted = {"exposure"} if config.hdr_weight > 0 and has_truth else set()
    if config.linear_weight > 0:
        wanted |= {"base"} if config.hdr_truth and has_truth else {"base", "exposure"}
    return frozenset(wanted)


def data_loss(
    field: RadianceField, photo: TrainRender, target: Target, config: LossConfig, largest_truth: float = 1.0
) -> Tensor:
    """L_LDR + beta L_linear (equation 13), the HDR loss and the anchor, each where it has a weight."""
    loss = ldr_loss(photo, target, config) if config.ldr_weight > 0 else 0.0
    if config.ldr_weight not in (0, 1):
        loss = config.ldr_weight * loss
    if config.hdr_weight > 0 and target.exposure_truth is not None:
        loss = loss + config.hdr_weight * hdr_loss(photo, target, config, largest_truth)
    if config.linear_weight > 0:
        linear = linear_loss(photo, target, config)
        loss = loss if linear is None else loss + config.linear_weight * linear
    if config.anchor_weight > 0 and isinstance(field.response, ToneMapper):
        loss = loss + config.anchor_weight * anchor_loss(field.response)
    assert isinstance(loss, Tensor), "a config without any loss is refused"
    return loss


def regularised(loss: Tensor, photo: TrainRender) -> Tensor:
    """Return the loss plus the opacity penalty, if the view was rendered with an opacity weight."""
    return loss if photo.opacity_penalty is None else loss + photo.opacity_penalty
