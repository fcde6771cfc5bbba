"""What a training minimises: photos against photos, exposures against exposures."""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from ..field.radiance_field import Photograph, RadianceField
from ..response import Response, ToneMapper
from ..splatting.one_sided import seen_by_photo
from ..splatting.ssim import image_distance, ssim
from .config import LossConfig

CODE = 1 / 255
"""One step of an 8-bit photo."""
MU = 5000.0
"""Of the mu-law in which HDR images are compared."""
KNEE = 8.0
"""The code of 255 whose exposure is white / mu in the mu-law of photos: light below counts as light, above as its
logarithm."""
ANCHOR = 0.5
"""What anchor_loss wants the unit exposure encoded as: the middle of the encoded range."""


@dataclass(frozen=True)
class Target:
    """One training photo on the device, at one resolution.

    photo: [H, W, 3] encoded values in [0, 1], or uint8 codes of 255; clipped, black: [H, W, 3] bool, or None where the
    photo has none of them;
    mask: [H, W, 1] in [0, 1] or None; exposure_truth: [H, W, 3] true radiance times the base time, or None;
    light: [H, W, 3] exposures decoded from the photo, where they are kept for every step; None: decode them.
    index: [1], int64, on the device; then photo is a stack [V, H, W, 3] that has the photo at this place.
    """

    photo: Tensor
    clipped: Tensor | None
    black: Tensor | None
    mask: Tensor | None
    exposure_truth: Tensor | None
    light: Tensor | None = None
    index: Tensor | None = None

    @property
    def encoded(self) -> Tensor:
        """[H, W, 3] in [0, 1], made of codes whenever it is asked for."""
        return values_of(one_of(self.photo, self.index))


def one_of(stack: Tensor, index: Tensor | None) -> Tensor:
    """A copy of the one of a stack [V, ...] that is at index [1], on its device; without an index the tensor itself."""
    return stack if index is None else stack.index_select(0, index)[0]


def values_of(photo: Tensor) -> Tensor:
    """Encoded values, float32, of a photo that may be stored as uint8 codes."""
    # By a tensor: torch's division by a number on a GPU is a product with its reciprocal, which rounds differently.
    return photo if photo.dtype != torch.uint8 else photo / torch.full((), 255.0, device=photo.device)


def one_sided(prediction: Tensor, truth: Tensor, target: Target, half_codes: tuple[float, float]) -> Tensor:
    """The prediction [H, W, 3] as far as the photo can tell: the truth, plus what lies outside of the bounds.

    A clipped pixel says `at least white less half a code`, so what is brighter equals it: without the half code a
    response that never quite reaches white would be pulled up for ever. A black pixel says `at most half a code`, so
    what is darker equals it. truth: [H, W, 3], the photo in the prediction's domain; half_codes: there, of half a code
    below white and above black.
    """
    seen = prediction
    if target.clipped is not None:
        seen = torch.where(target.clipped, truth + (prediction - (truth - half_codes[0])).clamp_max(0), seen)
    if target.black is not None:
        seen = torch.where(target.black, truth + (prediction - (truth + half_codes[1])).clamp_min(0), seen)
    return seen


def image_loss(prediction: Tensor, truth: Tensor, mask: Tensor | None, form: str, weight: float) -> Tensor:
    """L1 + weight (1 - SSIM) ("sum", SeHDR's equation 11) or (1 - weight) L1 + weight (1 - SSIM) ("blend", 3DGS).

    prediction, truth: [H, W, 3]; mask: [H, W, 1] or None: pixels outside count nothing in L1 and as equal in SSIM.
    """
    if weight and mask is None and prediction.device.type == "cuda" and not truth.requires_grad:
        return image_distance(prediction, truth, 1.0 if form == "sum" else 1 - weight, weight)
    if mask is not None:
        prediction, truth = prediction * mask, truth * mask
    difference = (prediction - truth).abs().mean()
    if mask is not None:
        difference = difference / mask.mean().clamp_min(1e-6)
    if weight == 0:
        return difference
    dissimilarity = 1 - ssim(prediction, truth)
    return (difference if form == "sum" else (1 - weight) * difference) + weight * dissimilarity


def ldr_loss(photo: Photograph, target: Target, config: LossConfig, response: Response | None = None) -> Tensor:
    """The photo against the simulated one, L_LDR: in the mu-law of exposures where pixels have one and the response is
    known, else as encoded values. With `clipping` one-sided where the camera saturated."""
    if photo.light is None or response is None or isinstance(response, ToneMapper):
        prediction, truth, half_codes = photo.encoded, target.encoded, (CODE / 2, CODE / 2)
    else:
        white, mu = response.white, mu_of_knee(response)
        half_codes = _half_codes(response, mu)
        photo_light = response.decode(target.encoded) if target.light is None else target.light
        if config.clipping and photo.light.device.type == "cuda":
            masks = target.clipped, target.black
            seen, truth = seen_by_photo(photo.light, photo_light, *masks, white=white, mu=mu, half_codes=half_codes)
            return image_loss(seen, truth, target.mask, config.form, config.ssim_weight)
        prediction, truth = mu_law(photo.light, white, mu), mu_law(photo_light, white, mu)
    seen = one_sided(prediction, truth, target, half_codes) if config.clipping else prediction
    return image_loss(seen, truth, target.mask, config.form, config.ssim_weight)


def compares_light(config: LossConfig, field: RadianceField) -> bool:
    """Whether ldr_loss decodes the photos of this field's training."""
    decodable = field.radiance != "display" and field.tone_map == "pixel" and not isinstance(field.response, ToneMapper)
    return config.ldr_weight > 0 and decodable


@lru_cache(maxsize=16)
def mu_of_knee(response: Response) -> float:
    """The mu whose knee, white / mu, is the exposure of code KNEE of 255: the same place among the codes for any
    curve, where one mu would leave all shadows of a curve that never clips below it."""
    return response.white / max(float(response.decode(KNEE / 255)), 1e-12)


@lru_cache(maxsize=16)
def _half_codes(response: Response, mu: float) -> tuple[float, float]:
    """How far half a code below white and half a code above black are from them, in the mu-law of exposures."""
    exposures = (1.0, 1.0 - CODE / 2, CODE / 2, 0.0)
    white, below, above, black = (
        math.log1p(mu * float(response.decode(value)) / response.white) / math.log1p(mu) for value in exposures
    )
    return white - below, above - black


def _is_decodable(photo: Photograph, response: Response | None) -> bool:
    """Whether the simulated photo's pixels have exposures, and a curve that is not itself learned tells the photo's."""
    return photo.light is not None and response is not None and not isinstance(response, ToneMapper)


def mu_law(exposure: Tensor, white: float, mu: float = MU) -> Tensor:
    """log(1 + mu x / white) / log(1 + mu): 0 for no light, 1 for the exposure that photos show as white."""
    return torch.log1p(exposure * (mu / white)) / math.log1p(mu)


def anchor_loss(mapper: ToneMapper) -> Tensor:
    """Mean over channels of (f(1) - ANCHOR)^2: photos of one exposure leave a learned f's scale open, and it drifts.

    Source: the unit exposure loss of HDR-NeRF (CVPR 2022), which GaussHDR (CVPR 2025) keeps, as its value for
    photos.
    """
    log_unit = mapper.weights[0].new_zeros(1, 3)
    return (mapper.encode_log(log_unit) - ANCHOR).square().mean()


def linear_loss(photo: Photograph, target: Target, config: LossConfig) -> Tensor | None:
    """SeHDR's L_linear: base exposure against true exposure where there is truth (and hdr_truth is on), else against
    the fused one; None where there is nothing to compare."""
    if config.hdr_truth and target.exposure_truth is not None:
        return image_loss(photo.base, target.exposure_truth, target.mask, config.form, config.ssim_weight)
    if photo.base is photo.exposure:
        return None
    # The base follows: without the detached side both would settle on what is easiest to agree on.
    return image_loss(photo.base, photo.exposure.detach(), target.mask, config.form, config.ssim_weight)


def hdr_loss(photo: Photograph, target: Target, config: LossConfig, largest: float) -> Tensor:
    """The HDR colour's exposure against the true one, both divided by `largest`, in the mu-law.

    largest: the greatest true exposure of the training views, see largest_truth. Source: HDR-GS's HDR loss, which
    divides each image by its own maximum instead, and with that leaves the scale of the scene open.
    """
    images = photo.exposure / largest, target.exposure_truth / largest
    return image_loss(*(mu_law(image, 1.0) for image in images), target.mask, config.form, config.ssim_weight)


def needed_colours(config: LossConfig, has_truth: bool) -> frozenset[str]:
    """What RadianceField.photograph must render besides the photo for data_loss of a view with or without HDR truth:
    a colour set that nothing is compared with costs channels of every blend."""
    wanted = set()
    if config.hdr_weight > 0 and has_truth:
        wanted.add("exposure")
    if config.linear_weight > 0:
        wanted |= {"base"} if config.hdr_truth and has_truth else {"base", "exposure"}
    return frozenset(wanted)


def data_loss(
    field: RadianceField, photo: Photograph, target: Target, config: LossConfig, largest_truth: float = 1.0
) -> Tensor:
    """L_LDR + beta L_linear (equation 13), the HDR loss and the anchor, each where it has a weight."""
    loss = ldr_loss(photo, target, config, field.response) if config.ldr_weight > 0 else 0.0
    if config.ldr_weight not in (0, 1):
        loss = config.ldr_weight * loss
    if config.hdr_weight > 0 and target.exposure_truth is not None:
        loss = loss + config.hdr_weight * hdr_loss(photo, target, config, largest_truth)
    if config.linear_weight > 0:
        linear = linear_loss(photo, target, config)
        loss = loss if linear is None else loss + config.linear_weight * linear
    if config.anchor_weight > 0:
        loss = loss + config.anchor_weight * anchor_loss(field.response)
    return loss


def regularised(loss: Tensor, field: RadianceField, config: LossConfig) -> Tensor:
    """The loss and what the Gaussians themselves cost, whatever the view: the opacities."""
    if config.opacity_weight > 0:
        loss = loss + config.opacity_weight * field.gaussians.opacities().mean()
    return loss
