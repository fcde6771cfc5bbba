"""Image metrics on torch tensors: mu-law, PSNR, SSIM, PU21, and the regions of a photo they are reported for.

Images are [H, W, C]; a mask is [H, W] with weights in [0, 1], None for all ones. Metrics return Python floats: infinity
for identical images under PSNR, NaN where a mask leaves nothing.
"""

import math

import torch
from torch import Tensor

from ..rasterizer.ssim import ssim_map

# A photo's pixel is clipped if any channel reaches this code of 255: JPEG blurs 255 by a few codes.
CLIPPED_CODE = 250
# It is dark if no channel exceeds this code: there one code is more than 6 % of the value, and of radiance twice that.
DARK_CODE = 16
REGIONS = ("clipped", "well-exposed", "dark")

# Rec.709 luminance weights, as in the PU21 reference implementation.
LUMINANCE = (0.212656, 0.715158, 0.072186)
# PU21 "banding_glare", the variant its authors recommend, and its range in cd/m^2.
PU21 = (0.353487901, 0.3734658629, 8.277049286e-05, 0.9062562627, 0.09150303166, 0.9099517204, 596.3148142)
PU21_RANGE = (0.005, 10000.0)
# The peak that the reference implementation uses for PSNR and SSIM of PU21 values; 100 cd/m^2 encode to 256.
PU21_PEAK = 256.0


def mu_law(radiance: Tensor, mu: float = 5000.0) -> Tensor:
    """log(1 + mu E) / log(1 + mu) (SeHDR, section 4.1; Kalantari and Ramamoorthi 2017) of radiance of any shape, first
    limited to [0, 1], as HDR-NeRF and HDR-GS do."""
    return torch.log1p(mu * radiance.clamp(0.0, 1.0)) / math.log1p(mu)


def psnr(
    prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, peak: float = 1.0, channels_apart: bool = False
) -> float:
    """Peak signal-to-noise ratio in dB: 10 log10(peak^2 / MSE), or with channels_apart the mean over channels of it."""
    error, weight = squared_error(prediction, truth, mask)
    if not weight:
        return math.nan
    means = error if channels_apart else error.mean(0, keepdim=True)
    return math.fsum(decibels(float(mean) / weight, peak) for mean in means) / len(means)


def squared_error(prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> tuple[Tensor, float]:
    """The sum of weighted squared errors for each channel [C] (float64), and the sum of the weights."""
    squared = (prediction.double() - truth.double()) ** 2
    if mask is None:
        return squared.sum((0, 1)), float(squared.shape[0] * squared.shape[1])
    weights = mask.double()[..., None]
    # What the mask leaves out may be anything: 0 times NaN would be NaN.
    return torch.where(weights > 0, squared * weights, 0.0).sum((0, 1)), float(weights.sum())


def decibels(mean_squared_error: float, peak: float = 1.0) -> float:
    """10 log10(peak^2 / mean_squared_error); infinity for 0, NaN for NaN."""
    return math.inf if mean_squared_error == 0 else 10 * math.log10(peak**2 / mean_squared_error)


def ssim(prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, peak: float = 1.0) -> float:
    """Structural similarity (rasterizer.ssim), averaged over pixels and channels; a mask weights the average only.

    Border pixels count, as in the code of 3DGS and HDR-GS; HDR-NeRF's script uses a uniform 7 x 7 window without them.
    """
    values = ssim_map((prediction / peak).float(), (truth / peak).float()).double().mean(2)
    if mask is None:
        return float(values.mean())
    weight = float(mask.double().sum())
    return float((values * mask.double()).sum()) / weight if weight else math.nan


def pu21_encode(luminance: Tensor) -> Tensor:
    """PU21 values of absolute luminance or color, limited to [0.005, 10000] cd/m^2: 0 at 0.005, 256 at 100, 595 at
    10000 (Mantiuk and Azimi, PU21, PCS 2021)."""
    p = PU21
    power = luminance.double().clamp(*PU21_RANGE) ** p[3]
    return p[6] * (((p[0] + p[1] * power) / (1 + p[2] * power)) ** p[4] - p[5])


def pu21_metrics(
    prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, peak_luminance: float = 1000.0
) -> dict[str, float]:
    """PSNR of PU21-encoded color and SSIM of PU21-encoded luminance, both with peak 256: {"psnr": dB, "ssim": ...}.

    prediction, truth: [H, W, 3] relative radiance in one unit, Rec.709 primaries. PU21 needs absolute values: the
    truth's maximum is shown at peak_luminance cd/m^2, and the prediction by the same factor.
    """
    factor = peak_luminance / maximum(truth, mask)
    ours, theirs = prediction.double() * factor, truth.double() * factor
    decibels = psnr(pu21_encode(ours), pu21_encode(theirs), mask, peak=PU21_PEAK)
    gray, gray_truth = (pu21_encode((image @ image.new_tensor(LUMINANCE))[..., None]) for image in (ours, theirs))
    return {"psnr": decibels, "ssim": ssim(gray, gray_truth, mask, peak=PU21_PEAK)}


def maximum(image: Tensor, mask: Tensor | None) -> float:
    """The largest value where the mask counts; 1 for an image without light, which then stays black."""
    counted = image if mask is None else image[mask > 0]
    largest = float(counted.max()) if counted.numel() else 0.0
    return largest if largest > 0 else 1.0


def region_masks(photo: Tensor) -> dict[str, Tensor]:
    """{region: [H, W] bool} for REGIONS, which part the pixels of a photo [H, W, 3], encoded in [0, 1]."""
    codes = photo * 255
    clipped = (codes >= CLIPPED_CODE - 0.5).any(2)
    dark = (codes <= DARK_CODE + 0.5).all(2)
    return {"clipped": clipped, "well-exposed": ~(clipped | dark), "dark": dark}
