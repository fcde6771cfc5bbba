"""Error-guided seeding: new Gaussians where a photo is reproduced worst, at depths on which photos agree."""

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ..model.color_models import ColorModel
from ..model.radiance_field import RadianceField
from ..rasterizer.plane_sweep import BORDER
from ..rasterizer.residual_sampling import sample_residual_pixels
from ..response import Response
from ..splats.arrays import HARMONIC_0
from .matching import Matcher
from .strategies import Proposals
from .strategies.mcmc import MAX_DISTANCE
from .targets import TrainingView

MAX_SEEDS = 500  # Gaussians per refinement
INITIAL_OPACITY = 0.5  # High enough for the training to shape them
MIN_ERROR = 0.02  # Mean difference of encoded values above which a pixel can be seeded


@torch.no_grad()
def seed_gaussians(
    field: RadianceField,
    matcher: Matcher,
    rendered: Tensor,
    view: TrainingView,
    index: int,
    number: Tensor,
    bound: int,
    random_seed: int,
) -> Proposals:
    """Return new Gaussians at pixels sampled by their squared error. Does not wait for the device.

    Args:
        field: The field that is trained.
        matcher: Matcher of the training photos.
        rendered: [H, W, 3] the view as the scene renders it, encoded.
        view: The view.
        index: Index of the view in the matcher.
        number: int64 [], number of Gaussians.
        bound: Upper bound of `number` on the host.
        random_seed: Seed of the sampling.
    """
    bound = min(bound, MAX_SEEDS) if min(matcher.size(index)) > 2 * BORDER else 0
    uniform, target = torch.from_numpy(np.random.default_rng(random_seed).random(bound)), view.target
    if rendered.device.type == "cuda":
        uniform = uniform.pin_memory().to(rendered.device, non_blocking=True)
    pixels, sampled = sample_residual_pixels(
        *(rendered, target.codes, target.index, target.mask, uniform, index, matcher.size(index)), least=MIN_ERROR
    )
    matches, valid = matcher.match_each(pixels)
    valid &= sampled & (torch.arange(bound, device=valid.device) < number)
    starts = _start_values(field.color_model, field.response, matches.colors.device)
    start = starts.gather(0, (matches.colors * 255).round().long())
    rest = field.gaussians.harmonics_rest
    nearer = (MAX_DISTANCE / matches.points.norm(dim=1)).clamp_max(1.0)
    quaternions = torch.zeros(bound, 4, device=rest.device)
    quaternions[:, 0] = 1
    rows = {
        "means": matches.points * nearer[:, None],
        "log_scales": (matches.footprints * nearer).log()[:, None].repeat(1, 3),
        "quaternions": quaternions,
        "opacity_logits": rest.new_full((bound,), math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))),
        "harmonics_dc": (start / HARMONIC_0).to(rest)[:, None, :],
        "harmonics_rest": rest.new_zeros(bound, *rest.shape[1:]),
    }
    order = valid.byte().argsort(descending=True, stable=True)
    return Proposals({name: values[order] for name, values in rows.items()}, valid.sum())


@lru_cache(maxsize=1)
def _start_values(model: ColorModel, response: Response, device: torch.device) -> Tensor:
    """Return [256, 3] start values of the harmonics' constant part for each 8-bit code."""
    levels = np.arange(256, dtype=np.float32)[:, None].repeat(3, 1) / np.float32(255)
    return torch.from_numpy(model.start(levels, response)).to(device)
