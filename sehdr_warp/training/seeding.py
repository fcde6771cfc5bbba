"""Seeds, new Gaussians where a photo is reproduced worst; and the light of those, seeds or initial, that photos clip.

A clipped photo shows white whatever the light is, so they begin at the light of DataManager.light_estimates.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ..model.color_models import ColorModel
from ..model.radiance_field import RadianceField
from ..rasterizer.losses.code_residual import sample_residual_pixels
from ..rasterizer.ops.plane_sweep import BORDER
from ..response import Response
from ..scene import Camera, View
from ..scene.wide_camera import pixels_of_directions
from ..splats.arrays import HARMONIC_0
from ..subsets import every_nth
from .matching import Matcher
from .strategies import Seeds
from .strategies.mcmc import MAX_DISTANCE
from .training_views import TrainingView

WHITE_TOLERANCE = 1e-4  # Of values of the harmonics' constant part that are compared with that of white
MAX_SEEDS = 500  # Gaussians per refinement
INITIAL_OPACITY = 0.5  # Of a seed; high enough for the training to shape it
MIN_ERROR = 0.02  # Mean difference of encoded values above which a pixel can be seeded
MOST_BRIGHTENED_BY = 100  # Photos whose estimates of clipped light are averaged


@torch.no_grad()
def make_seeds(
    field: RadianceField,
    matcher: Matcher,
    rendered: Tensor,
    view: TrainingView,
    index: int,
    number: Tensor,
    bound: int,
    random_seed: int,
) -> Seeds:
    """Return new Gaussians at pixels sampled by their squared error, at depths on which photos agree.

    Does not wait for the device.

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
        rendered, target.codes, target.index, target.mask, uniform, index, matcher.size(index), least=MIN_ERROR
    )
    matches, valid = matcher.match_each(pixels)
    valid &= sampled & (torch.arange(bound, device=valid.device) < number)
    starts = _start_values(field.color_model, field.response, matches.colors.device)
    start = starts.gather(0, (matches.colors * 255).round().long())
    if target.estimates is not None:
        times = field.base_time / float(view.exposure_time)
        excess = expected_excess(target.estimates, pixels[:, 1:].long(), matcher.size(index), times)
        is_white = start >= starts[-1] - WHITE_TOLERANCE
        start = field.color_model.brighten(start, torch.where(is_white, excess, 0))
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
    return Seeds({name: values[order] for name, values in rows.items()}, valid.sum())


@lru_cache(maxsize=1)
def _start_values(model: ColorModel, response: Response, device: torch.device) -> Tensor:
    """Return [256, 3] start values of the harmonics' constant part for each 8-bit code."""
    levels = np.arange(256, dtype=np.float32)[:, None].repeat(3, 1) / np.float32(255)
    return torch.from_numpy(model.start(levels, response)).to(device)


def expected_excess(estimate: Tensor, pixels: Tensor, size: tuple[int, int], times: float = 1.0) -> Tensor:
    """Return [N, 3] the logarithm, at least 0, of the expected light over white at a photo's pixels.

    It is 0 where nothing is known. Does not wait for the device.

    Args:
        estimate: ClippedLight.log_light [h, w, 6] of the photo.
        pixels: [N, 2] int64 column and row; others than the photo has count as the nearest.
        size: Width and height of the photo.
        times: The exposure time whose white is meant, over that of the photo.
    """
    x, y = ((pixels[:, axis] + 0.5) / size[axis] for axis in (0, 1))
    light, root = estimates_at(estimate, x, y).float().split(3, dim=1)
    return torch.where(root > 0, (light + math.log(times)).clamp_min(0), 0)


def estimates_at(estimates: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return estimates [h, w, C] at image positions x, y [N] in [0, 1), the nearest beyond."""
    rows, columns = estimates.shape[:2]
    return estimates[(y * rows).long().clamp(0, rows - 1), (x * columns).long().clamp(0, columns - 1)]


@torch.no_grad()
def brighten_clipped(field: RadianceField, views: Sequence[View], estimates: Sequence[Tensor]) -> None:
    """Brighten the Gaussians of a field at iteration 0 that are white, to the light that photos expect there.

    An optimizer moves the logarithm of a color by its learning rate. In short trainings, or for lamps that few photos
    show, that is too slow to reach a lamp a hundred times as bright as white from white.

    Photos agree by the weights of their estimates, as in the loss. A channel that is not white stays as it is.

    Args:
        field: Its constant colors are those of photos.
        views: Training views, in the field's normalized coordinates.
        estimates: ClippedLight.log_light [h, w, 6] of each view.
    """
    gaussians, model = field.gaussians, field.color_model
    values = gaussians.harmonics_dc[:, 0] * HARMONIC_0
    white = torch.from_numpy(model.start(np.ones((1, 3)), field.response)).to(values)
    is_white = values >= white - WHITE_TOLERANCE
    index = is_white.any(1).nonzero()[:, 0]
    points, sums, weights = gaussians.means[index], 0.0, torch.full((len(index), 3), 1e-12).to(values)
    for view, estimate in every_nth(list(zip(views, estimates, strict=True)), MOST_BRIGHTENED_BY):
        if len(index) and bool(estimate.any()):
            positions = _image_positions(view.camera, points)
            inside = ((positions >= 0) & (positions < 1)).all(1)
            x, y = torch.where(inside[:, None], positions, 0).T
            cells = estimates_at(estimate.to(values), x, y)
            weight = cells[:, 3:].square() * inside[:, None]
            sums = sums + weight * (cells[:, :3] + math.log(field.base_time / view.exposure_time))
            weights += weight
    excess = torch.where(is_white[index], (sums / weights).clamp_min(0), 0)
    gaussians.harmonics_dc[index, 0] = model.brighten(values[index], excess) / HARMONIC_0


def _image_positions(camera: Camera, points: Tensor) -> Tensor:
    """Return where a camera's image shows points [N, 3]: [N, 2] x and y, in [0, 1) within it, or NaN."""
    pose = torch.tensor(camera.world_to_camera).to(points)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    if camera.is_pinhole:
        focal, middle = points.new_tensor([[camera.fx, camera.fy], [camera.cx, camera.cy]])
        pixels = torch.where(local[:, 2:] > 1e-9, local[:, :2] / local[:, 2:] * focal + middle, math.nan)
    else:
        directions = (local / local.norm(dim=1, keepdim=True).clamp_min(1e-12)).cpu().numpy()
        pixels = torch.tensor(pixels_of_directions(directions, camera)[:, ::-1] + 0.5).to(points)
    return pixels / points.new_tensor([camera.width, camera.height])
