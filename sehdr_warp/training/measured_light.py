"""Light of clipped pixels that darker photos show unclipped, in place of its estimates.

Every photo that clips a light has an estimate of it, whose errors the photos share. Together they would outvote a few
darker photos, which measure the light, and harmonics would give it other light towards these alone.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..model.radiance_field import RadianceField
from ..runs.light_estimates import by_solid_angle
from ..scene import View

if TYPE_CHECKING:
    from .trainer import Trainer

UPDATES = 0.25, 0.5, 0.75  # Parts of a training after which the scene says which pixels show what darker photos measure
DARKER = 0.5  # Part of the longest exposure up to which a photo measures light
LEAST_CODE = 3  # Of 255, from which a photo measures light: half a code is at most a sixth of it
LEAST_PIXELS, LEAST_PART = 0.05, 0.25
"""Pixels of blending weight in darker photos from which they measure a Gaussian, and the part of its weight in a mean
photo of the others that a mean darker photo must have."""
LEAST_SHARE = 0.75  # Of a pixel's light that must be of Gaussians that are measured
LARGEST_RATIO = 16.0  # By which measured light may differ from the scene's at once
DEVIATION = 0.25 * math.log(2)  # Of the natural logarithm of measured light
CERTAIN = 2.0
"""Light of a file that is so many times as certain as what is measured stays if both differ by fewer DEVIATIONs."""


class MeasuredRadiance(NamedTuple):
    """Light of each Gaussian that darker views measure, by channel."""

    radiance: Tensor  # [N, 3]
    is_known: Tensor  # bool [N, 3]


def are_measured(views: Sequence[View]) -> bool:
    """Return whether some views have at most half of the exposure of others."""
    times = [view.exposure_time for view in views]
    return min(times) <= DARKER * max(times)


def replace_measured(trainer: "Trainer") -> None:
    """Replace estimates of clipped light that darker photos measure, in the step that comes to a part of UPDATES."""
    views, estimates, total = trainer.scene.train_views, trainer.data_manager.estimates, trainer.total
    before = trainer.iteration - trainer.step_batch
    due = any(before < part * total <= trainer.iteration for part in UPDATES)
    if due and estimates is not None and are_measured(views):
        with trainer.step_runner.on_capture_stream():
            measured = measured_estimates(trainer.field, views, estimates, trainer.degree)
            trainer.data_manager.replace_estimates(measured)


@torch.no_grad()
def measured_estimates(
    field: RadianceField, views: Sequence[View], estimates: Sequence[Tensor], degree: int
) -> list[Tensor]:
    """Return the estimates of each view's clipped light, replaced where darker views measure it.

    Light that a view's file states stays if it agrees, because it is more certain.

    Args:
        field: The radiance field, as far as it is trained.
        views: Training views in scene coordinates.
        estimates: ClippedLight.log_light [h, w, 6] of each.
        degree: Of the harmonics.
    """
    longest = max(view.exposure_time for view in views)
    darker = [view.exposure_time <= DARKER * longest for view in views]
    light = _measured_radiance(field, views, darker, degree)
    return [
        _replace(field, view, estimate, light, degree) if estimate.any() else estimate
        for view, estimate in zip(views, estimates, strict=True)
    ]


def _measured_radiance(
    field: RadianceField, views: Sequence[View], darker: Sequence[bool], degree: int
) -> MeasuredRadiance:
    """Return what darker views measure. Pixels count by their masks."""
    device, count = field.gaussians.means.device, field.gaussians.count
    light, weights, others, every = (torch.zeros(count, size, device=device) for size in (3, 3, 1, 1))
    for view, dark in zip(views, darker, strict=True):
        camera = field.camera_tensors(view.camera)
        counts = torch.ones(*view.codes.shape[:2], 1, device=device)
        if view.mask is not None:
            counts = counts * torch.tensor(view.mask, device=device)[..., None]
        if not dark:
            others += field.weighted_sums(camera, counts)
            continue
        unclipped = (view.codes < view.levels).all(2, keepdims=True) & (view.codes >= LEAST_CODE * (view.levels // 255))
        unclipped = counts * torch.tensor(unclipped, device=device)
        photo = field.response.decode(torch.tensor(view.image, device=device)) / view.exposure_time
        scene = field.render(view.camera, degree=degree).hdr.to(device)
        ratio = (photo / scene.clamp_min(1e-12)).clamp(1 / LARGEST_RATIO, LARGEST_RATIO)
        images = torch.cat([unclipped * ratio, unclipped, counts], 2).float()
        sums = field.weighted_sums(camera, images)
        light += field.radiance_towards(view.camera.position, degree=degree) * sums[:, :3]
        weights += sums[:, 3:6]
        every += sums[:, 6:]
    usual = others * (sum(darker) / (len(darker) - sum(darker)))
    is_known = (weights > LEAST_PIXELS) & (weights > every / 2) & (weights > LEAST_PART * usual)
    return MeasuredRadiance(light / weights.clamp_min(1e-12), is_known)


def _replace(field: RadianceField, view: View, estimate: Tensor, light: MeasuredRadiance, degree: int) -> Tensor:
    """Return the estimates [h, w, 6] of a view, replaced where most of its light is of measured Gaussians."""
    own = field.radiance_towards(view.camera.position, degree=degree)
    part = torch.where(light.is_known, light.radiance, 0)
    whole = field.render_values(view.camera, torch.where(light.is_known, light.radiance, own))
    is_known = field.render_values(view.camera, part) > LEAST_SHARE * whole
    clipped = torch.tensor(view.codes >= view.levels, device=whole.device)
    logarithm = (whole * (view.exposure_time / field.response.white)).clamp_min(1).log()
    parts = torch.cat([clipped, clipped & is_known, (clipped & is_known) * logarithm], 2).permute(2, 0, 1)[None]
    cells = F.interpolate(parts.float(), size=estimate.shape[:2], mode="area")[0].permute(1, 2, 0).to(estimate.device)
    white, some, total = cells.split(3, dim=2)
    new = torch.cat([total / some.clamp_min(1e-6), torch.full_like(total, 1 / DEVIATION)], 2)
    new = by_solid_angle(new.cpu(), view.camera).to(estimate)
    differs = (new - estimate)[..., :3].abs() > CERTAIN * DEVIATION  # As where a gain map ends below a lamp
    differs |= estimate[..., 3:] < CERTAIN / DEVIATION
    return torch.where((differs & (some > white / 2) & (white > 0)).repeat(1, 1, 2), new, estimate)
