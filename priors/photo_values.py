"""Batches of simulated photos, and what their numbers are made of: averages, medians, curves, cosines."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class Photos:
    """A batch of simulated photos; [B, 3, S, S] each.

    exposure: decoded, in units of white. clipped: the share of each value whose code is the largest. truth: log2 of the
    true exposure of that share over white, else 0.
    """

    exposure: Tensor
    clipped: Tensor
    truth: Tensor


def averaged(photos: Photos, size: int) -> Photos:
    """Return photos averaged to a smaller size: what clips in part has the mean light of that part as its truth."""
    if photos.exposure.shape[-1] == size:
        return photos
    light = photos.clipped * torch.exp2(photos.truth)
    exposure, share, light = (
        F.interpolate(v, size=(size, size), mode="area") for v in (photos.exposure, photos.clipped, light)
    )
    truth = torch.where(share > 0, light / share.clamp_min(1e-9), 1.0).log2()
    return Photos(exposure, share, truth)


def log_range(part: Tensor, low: float, high: float) -> Tensor:
    """Return the value at each part of a range, even in the logarithm."""
    return low * (high / low) ** part


def lower_median(values: Tensor) -> Tensor:
    """Return [B, 1] the lower median of each row of values [B, N]; torch.median has no deterministic form on GPUs."""
    return values.sort(1).values[:, (values.shape[1] - 1) // 2, None]


def interpolate(curves: Tensor, values: Tensor) -> Tensor:
    """Return each curve [B, K], at even steps of the cube root of exposure, at values [B, ...] in [0, 1]."""
    steps = curves.shape[1] - 1
    place = values.flatten(1) ** (1 / 3) * steps
    low = place.floor().long().clamp_max(steps - 1)
    part = place - low
    between = curves.gather(1, low) * (1 - part) + curves.gather(1, low + 1) * part
    return between.reshape(values.shape)


def inverse(curves: Tensor, encoded: Tensor) -> Tensor:
    """Return the exposures at which increasing curves [B, K] are encoded values [B, ...]."""
    steps = curves.shape[1] - 1
    flat = encoded.flatten(1).contiguous()
    high = torch.searchsorted(curves.contiguous(), flat).clamp(1, steps)
    low_value, high_value = curves.gather(1, high - 1), curves.gather(1, high)
    part = ((flat - low_value) / (high_value - low_value).clamp_min(1e-9)).clamp(0, 1)
    return (((high - 1 + part) / steps) ** 3).reshape(encoded.shape)


def dct(size: int) -> Tensor:
    """Return the orthonormal matrix [size, size] of the cosine transform."""
    k, i = torch.arange(size)[:, None], torch.arange(size)[None]
    matrix = torch.cos(math.pi * (2 * i + 1) * k / (2 * size)) * math.sqrt(2 / size)
    matrix[0] /= math.sqrt(2)
    return matrix
