"""New Gaussians where the photos are explained worst, at the depths that the photos agree on."""

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
from .densification import FARTHEST
from .matching import Matcher
from .targets import TrainingView

MOST = 500  # Gaussians that are born at a change
OPACITY = 0.5  # Of one that is born: it must be seen to be shaped
LEAST_ERROR = 0.02  # Mean difference of encoded values from which a pixel is not explained


@torch.no_grad()
def born_rows(
    field: RadianceField,
    matcher: Matcher,
    shown: Tensor,
    view: TrainingView,
    index: int,
    wanted: Tensor,
    room: int,
    seed: int,
) -> tuple[dict[str, Tensor], Tensor]:
    """Rows of Gaussians, as Gaussians.append takes them, of which the first are meant, and how many: of pixels drawn by
    the square of their error. Nothing waits for the device.

    shown: [H, W, 3] encoded, the scene from `view`. matcher: of the training photos, in which that of the view
    is the one at `index`. wanted: int64 [], how many at most, which is not above room. The same seed gives the same.
    """
    room = min(room, MOST) if min(matcher.size(index)) > 2 * BORDER else 0
    uniform, target = torch.from_numpy(np.random.default_rng(seed).random(room)), view.target
    if shown.device.type == "cuda":
        uniform = uniform.pin_memory().to(shown.device, non_blocking=True)
    drawn_by = shown, target.codes, target.index, target.mask, uniform, index, matcher.size(index)
    pixels, drawn = sample_residual_pixels(*drawn_by, least=LEAST_ERROR)
    found, known = matcher.match_each(pixels)
    known &= drawn & (torch.arange(room, device=known.device) < wanted)
    starts = _starts(field.color_model, field.response, found.colors.device)
    start = starts.gather(0, (found.colors * 255).round().long())
    rest = field.gaussians.harmonics_rest
    nearer = (FARTHEST / found.points.norm(dim=1)).clamp_max(1.0)
    quaternions = torch.zeros(room, 4, device=rest.device)
    quaternions[:, 0] = 1
    rows = {
        "means": found.points * nearer[:, None],
        "log_scales": (found.footprints * nearer).log()[:, None].repeat(1, 3),
        "quaternions": quaternions,
        "opacity_logits": rest.new_full((room,), math.log(OPACITY / (1 - OPACITY))),
        "harmonics_dc": (start / HARMONIC_0).to(rest)[:, None, :],
        "harmonics_rest": rest.new_zeros(room, *rest.shape[1:]),
    }
    order = known.byte().argsort(descending=True, stable=True)
    return {name: values[order] for name, values in rows.items()}, known.sum()


@lru_cache(maxsize=1)
def _starts(model: ColorModel, response: Response, device: torch.device) -> Tensor:
    """[256, 3] start values of the harmonics' constant part, for each code of a photo."""
    levels = np.arange(256, dtype=np.float32)[:, None].repeat(3, 1) / np.float32(255)
    return torch.from_numpy(model.start(levels, response)).to(device)
