"""Measure a run on photos: the errors of pixels near the borders of blocks, and of all other pixels."""

from dataclasses import dataclass

import numpy as np
import torch

from ..evaluation.metrics import decibels, squared_error
from ..runs.run import Run
from ..scene import View
from ..scene.wide_camera import surface_points
from .division import Division

NEAR = 0.5  # Distance from a border, in mean margins of the blocks, within which a pixel shows the border


@dataclass(frozen=True)
class SeamErrors:
    """Errors of simulated photos, dB of PSNR over the pixels of all views; NaN without such pixels."""

    psnr: float  # Mean over the views of their PSNR
    border: float  # Of pixels near a border between blocks
    elsewhere: float  # Of the other pixels
    share: float  # Fraction of the pixels near a border


@torch.no_grad()
def measure_seams(run: Run, views: tuple[View, ...], division: Division, depths: Run | None = None) -> SeamErrors:
    """Compare a run with photos, near the borders of blocks and elsewhere.

    Args:
        run: A trained run.
        views: Views with their photos, with the exposure compensation of the run.
        division: Division into blocks, in scene coordinates.
        depths: Run whose depths show which pixels are near a border; by default `run`. Comparing two runs needs one.
    """
    near = NEAR * float(division.margins.max(1).mean())
    sums, each = np.zeros((2, 2)), []
    for view in views:
        photo = torch.tensor(view.image, device=run.device)
        prediction = run.render_ldr(view.camera, view.exposure_time)
        depth = (depths or run).render(view.camera).depth.cpu().numpy()
        points = surface_points(view.camera, depth).reshape(-1, 3)
        at_border = (division.border_distance(points).reshape(depth.shape) < near) & (depth > 0)
        mask = np.ones(depth.shape) if view.mask is None else view.mask
        total = np.zeros(2)
        for row, part in enumerate((at_border, ~at_border)):
            error, weight = squared_error(prediction, photo, torch.tensor(mask * part, device=run.device))
            sums[row] += float(error.mean()), weight
            total += float(error.mean()), weight
        if total[1]:
            each.append(min(decibels(total[0] / total[1]), 100.0))
    border, elsewhere = (decibels(error / weight) if weight else float("nan") for error, weight in sums)
    share = float(sums[0, 1] / max(sums[:, 1].sum(), 1e-12))
    return SeamErrors(float(np.mean(each)) if each else float("nan"), border, elsewhere, share)
