"""What a training can do without, measured while it runs: degrees of the harmonics, and Gaussians that add nothing."""

import math

import torch
from torch import Tensor

from ..field.radiance_field import RadianceField
from .config import LossConfig
from .losses import data_loss, needed_colours
from .targets import TrainingView, ViewStack

MOST_VIEWS = 32
"""Training photos that a degree is judged by, evenly spread."""
LEAST_KEPT = 4
"""Gaussians that are left, whatever they add: a scene of none cannot be trained."""


@torch.no_grad()
def degree_gain(
    field: RadianceField,
    views: ViewStack | list[TrainingView],
    degree: int,
    loss: LossConfig,
    largest_truth: float = 1.0,
) -> float:
    """How many decibels the loss over training views, as an amplitude, is lower with the harmonics of a degree than
    without them, regularisers left out. What they gain here is the most that they can gain in views that were not
    trained on."""
    chosen = [views[index] for index in range(0, len(views), -(-len(views) // MOST_VIEWS))]
    sums = []
    for used in (degree - 1, degree):
        total = 0.0
        for view in chosen:
            target = view.target
            also = needed_colours(loss, target.exposure_truth is not None)
            photo = field.photograph(view.camera, view.exposure_time, degree=used, also=also)
            total += float(data_loss(field, photo, target, loss, largest_truth))
        sums.append(max(total, 1e-12))
    return 20 * math.log10(sums[0] / sums[1])


def contributing(field: RadianceField, views: ViewStack | list[TrainingView], least: float) -> Tensor:
    """[N] bool: Gaussians that add at least `least` pixels' worth to one of the views.

    A weight says more than an opacity: an opaque Gaussian behind a wall, or outside of every photo, adds nothing.
    (LightGaussian, NeurIPS 2024, ranks by such sums; here the bound is absolute, and over single views.)
    """
    greatest = field.gaussians.means.new_zeros(field.gaussians.count)
    for index in range(len(views)):
        camera = views[index].camera
        # Three channels of ones, though one is meant: a training has compiled its kernels for three.
        ones = greatest.new_ones(camera.height, camera.width, 3)
        torch.maximum(greatest, field.weighted_sums(camera, ones)[:, 0], out=greatest)
    kept = greatest >= least
    if int(kept.sum()) < LEAST_KEPT:
        count = min(LEAST_KEPT, len(greatest))
        kept = torch.zeros_like(kept).index_fill_(0, greatest.topk(count).indices, True)
    return kept
