"""Image metrics on torch tensors: mu-law, PSNR, SSIM, PU21, and the regions of a photo that they are reported for.

Images are [H, W, C]; a mask is [H, W] with weights in [0, 1], None for all ones. Metrics return Python floats. PSNR of
identical images is infinite; every metric is NaN if the mask is empty.
"""

import math

import torch
from torch import Tensor

from ..rasterizer.losses.ssim import ssim_map

CLIPPED_CODE = 250
"""A pixel of a photo is clipped if a channel reaches this code of 255, because JPEG changes 255 by a few codes."""
DARK_CODE = 16
"""A pixel is dark if no channel exceeds this code, where one code is over 6 % of the value and 12 % of radiance."""
REGIONS = ("clipped", "well-exposed", "dark")

LUMINANCE = (0.212656, 0.715158, 0.072186)  # Rec.709 luminance weights, as in the PU21 reference implementation
PU21 = (0.353487901, 0.3734658629, 8.277049286e-05, 0.9062562627, 0.09150303166, 0.9099517204, 596.3148142)
"""Parameters of PU21 "banding_glare", the variant that its authors recommend."""
PU21_RANGE = (0.005, 10000.0)  # Luminance that PU21 covers, cd/m^2
PU21_PEAK = 256.0
"""Peak that the reference implementation uses for PSNR and SSIM of PU21 values; 100 cd/m^2 encode to it."""


def mu_law(radiance: Tensor, mu: float = 5000.0) -> Tensor:
    """Return log(1 + mu E) / log(1 + mu) (SeHDR, equation 21; Kalantari and Ramamoorthi 2017).

    Args:
        radiance: E, of any shape; limited to [0, 1] first, as HDR-NeRF and HDR-GS do.
        mu: the compression.
    """
    return torch.log1p(mu * radiance.clamp(0.0, 1.0)) / math.log1p(mu)


def psnr(
    prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, peak: float = 1.0, channels_apart: bool = False
) -> float:
    """Return the peak signal-to-noise ratio 10 log10(peak^2 / MSE), dB.

    Args:
        prediction: [H, W, C].
        truth: [H, W, C].
        mask: weights, [H, W].
        peak: the largest value.
        channels_apart: average the ratios of the channels, rather than their errors.
    """
    error, weight = squared_error(prediction, truth, mask)
    if not weight:
        return math.nan
    means = error if channels_apart else error.mean(0, keepdim=True)
    return math.fsum(decibels(float(mean) / weight, peak) for mean in means) / len(means)


def squared_error(prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> tuple[Tensor, float]:
    """Return the sum of weighted squared errors of each channel, [C] float64, and the sum of the weights."""
    squared = (prediction.double() - truth.double()) ** 2
    if mask is None:
        return squared.sum((0, 1)), float(squared.shape[0] * squared.shape[1])
    weights = mask.double()[..., None]
    # Masked pixels may be NaN, and 0 times NaN is NaN.
    return torch.where(weights > 0, squared * weights, 0.0).sum((0, 1)), float(weights.sum())


def decibels(mean_squared_error: float, peak: float = 1.0) -> float:
    """Return 10 log10(peak^2 / mean_squared_error); infinity for 0, NaN for NaN."""
    return math.inf if mean_squared_error == 0 else 10 * math.log10(peak**2 / mean_squared_error)


def ssim(prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, peak: float = 1.0) -> float:
    """Return the structural similarity (rasterizer.ssim), averaged over pixels and channels.

    A mask weights the average only. Border pixels count, as in the code of 3DGS and HDR-GS; HDR-NeRF's script uses a
    uniform 7 x 7 window without them.
    """
    values = ssim_map((prediction / peak).float(), (truth / peak).float()).double().mean(2)
    if mask is None:
        return float(values.mean())
    weight = float(mask.double().sum())
    return float((values * mask.double()).sum()) / weight if weight else math.nan


def pu21_encode(luminance: Tensor) -> Tensor:
    """Return PU21 values of absolute luminance or color (Mantiuk and Azimi, PU21, PCS 2021).

    Args:
        luminance: cd/m^2, of any shape, limited to [0.005, 10000]. 0.005 encodes to 0, 100 to 256, 10000 to 595.
    """
    p = PU21
    power = luminance.double().clamp(*PU21_RANGE) ** p[3]
    return p[6] * (((p[0] + p[1] * power) / (1 + p[2] * power)) ** p[4] - p[5])


def pu21_metrics(
    prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, peak_luminance: float = 1000.0
) -> dict[str, float]:
    """Return PSNR of PU21-encoded color and SSIM of PU21-encoded luminance, both with peak 256.

    Args:
        prediction: relative radiance with Rec.709 primaries, [H, W, 3].
        truth: the same, in the unit of the prediction.
        mask: weights, [H, W].
        peak_luminance: cd/m^2 of the truth's maximum, because PU21 needs absolute values. The prediction is scaled by
            the same factor.

    Returns:
        "psnr" in dB, and "ssim".
    """
    factor = peak_luminance / maximum(truth, mask)
    predicted_luminance, true_luminance = prediction.double() * factor, truth.double() * factor
    decibels = psnr(pu21_encode(predicted_luminance), pu21_encode(true_luminance), mask, peak=PU21_PEAK)
    gray, gray_truth = (
        pu21_encode((image @ image.new_tensor(LUMINANCE))[..., None]) for image in (predicted_luminance, true_luminance)
    )
    return {"psnr": decibels, "ssim": ssim(gray, gray_truth, mask, peak=PU21_PEAK)}


def maximum(image: Tensor, mask: Tensor | None) -> float:
    """Return the largest value inside the mask; 1 for an image without light, which then stays black."""
    values = image if mask is None else image[mask > 0]
    largest = float(values.max()) if values.numel() else 0.0
    return largest if largest > 0 else 1.0


def region_masks(photo: Tensor) -> dict[str, Tensor]:
    """Divide the pixels of a photo, encoded in [0, 1], into REGIONS: a mask [H, W] bool for each, and none for two."""
    codes = photo * 255
    clipped = (codes >= CLIPPED_CODE - 0.5).any(2)
    dark = (codes <= DARK_CODE + 0.5).all(2)
    return {"clipped": clipped, "well-exposed": ~(clipped | dark), "dark": dark}
