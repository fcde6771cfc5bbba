"""The catalogue's training: where it diverges, what the guards do, and what resets and clipped batches do to it."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial

import numpy as np
import torch

from benchmarks.splats import EXPOSURE_TIME, Size, make_photo_scene
from sehdr_warp.check.case import Case, Reading, count, not_finite
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import Scene
from sehdr_warp.training.initialization import make_field
from sehdr_warp.training.losses import data_loss, opacity_loss
from sehdr_warp.training.trainer import Trainer
from sehdr_warp.training.training_state import state_of
from sehdr_warp.training.training_views import ViewDataset

STEPS, SIZE = 40, 32
RATES = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics_dc", "harmonics_rest")


@cache
def _photos(clipped: float = 0.0) -> Scene:
    """Photos and points without their colors. clipped: this share of each photo's rows is white."""
    scene = make_photo_scene(Size(300, SIZE, SIZE), 6)
    for view in scene.views:
        view.codes[: round(clipped * SIZE)] = 255
    return replace(scene, point_colors=np.full_like(scene.point_colors, 0.5))


def _trainer(device, clipped: float = 0.0, fields: Mapping[str, object] | None = None) -> Trainer:
    """Prepare a short training that neither adds nor moves Gaussians by itself. fields: of the config."""
    still = {"densification.refine_stop_iter": 0, "mcmc.noise_lr": 0.0, "schedule.sh_degree_interval": 30_000}
    config = load_config("default", {"schedule.iterations": STEPS, "seed": 1} | still | dict(fields or {}))
    scene = _photos(clipped)
    return Trainer(scene, config, make_field(scene, config, response_by_name("srgb"), device))


def _losses(trainer: Trainer, steps: int) -> list[float]:
    losses = []
    for _ in range(steps):
        trainer.step()
        losses.append(trainer.loss)
    return losses


def _state_not_finite(trainer: Trainer) -> int:
    return not_finite(*(tensor for tensor in state_of(trainer).tensors.values() if tensor.is_floating_point()))


def _learning_rates(device):
    """All learning rates times 1, 10, 100 and 1000: the loss relative to the start's, and what stays finite."""
    for factor in (1, 10, 100, 1000):
        rates = {name: getattr(Config().optimizer, name) for name in RATES}
        fields = {f"optimizer.{name}": min(1.0, rate * factor) for name, rate in rates.items()}
        trainer = _trainer(device, fields=fields)
        losses = _losses(trainer, STEPS)
        yield count(f"rates x {factor}: numbers of the state not finite", _state_not_finite(trainer))
        # At its own rates a training must descend. Far above, the loss of encoded values must stay bounded.
        last = float(np.mean(losses[-8:])) / losses[0]
        yield Reading(f"rates x {factor}: last loss / first", last, 0.8 if factor == 1 else 3.0)


def _gradient_norms(device):
    """Finite, and none drowns the photo's by 1e4."""
    field = _trainer(device).field
    view = ViewDataset(_photos().train_views, field.base_time, device, truth=False)[0]
    norms, broken = {}, 0
    for name, ssim, opacity in (("L1", 0.0, 0.0), ("L1 and SSIM", 0.2, 0.0), ("opacity", 0.0, 0.01)):
        config = load_config("default", {"loss.ssim_weight": ssim, "loss.opacity_weight": opacity}).loss
        photo = field.render_photo(view.camera, view.exposure_time)
        field.zero_grad(set_to_none=True)
        (data_loss(field, photo, view.target, config) + opacity_loss(field, photo, config.opacity_weight)).backward()
        gradients = [p.grad for p in field.gaussians.parameters() if p.grad is not None]
        broken += not_finite(*gradients)
        norms[name] = math.sqrt(sum(float(gradient.square().sum()) for gradient in gradients))
    for name, norm in norms.items():
        yield Reading(f"{name}: gradient / L1's", norm / norms["L1"], 1e4)
    yield count("gradients not finite", broken)


def _scale_ambiguity(device):
    """Compare the photo of radiance k at time t / k with the photo at t: they are the same.

    With a fixed response that direction is exactly flat; a free response would add its own. The base time takes it out:
    colors are exposures at that time.
    """
    camera, field = _photos().train_views[0].camera, _trainer(device).field

    def photo(factor):
        time = EXPOSURE_TIME * factor
        return RadianceField(field.gaussians, field.response, base_time=time).render_ldr(camera, time).double()

    for factor in (2.0**-20, 1e-3, 1e3, 2.0**20):
        error = float((photo(1.0) - photo(factor)).abs().max())
        yield Reading(f"photo at base time x {factor:.3g}", error, 2.0**-22)


def _opacity_reset(device):
    """Check that after a reset of all opacities to 0.01 the loss is finite, and soon within twice its old value."""
    trainer = _trainer(device)
    before = _losses(trainer, STEPS // 2)[-1]
    with torch.no_grad():
        gaussians = trainer.field.gaussians
        lowered = gaussians.opacity_logits.clamp(max=math.log(0.01 / 0.99))
        gaussians.overwrite({"opacity_logits": lowered}, trainer.optimizer)
    losses = _losses(trainer, 60)
    yield count("steps skipped", trainer.skipped_steps)
    yield count("numbers of the state not finite", _state_not_finite(trainer))
    yield Reading("worst loss after the reset / before", max(losses) / before, 100.0)
    yield Reading("loss 60 steps later / before", float(np.mean(losses[-6:])) / before, 2.0)


def _clipped_batches(device):
    """No step is lost, and nothing runs away."""
    for share in (0.5, 0.97):
        trainer = _trainer(device, clipped=share)
        _losses(trainer, STEPS)
        brightest = float(trainer.field.gaussians.harmonics_dc.detach().abs().max())
        yield count(f"{share:.0%} clipped: steps skipped", trainer.skipped_steps)
        yield count(f"{share:.0%} clipped: numbers not finite", _state_not_finite(trainer))
        # A clipped pixel says `at least white`: from a start near white, 40 steps of 0.02 are the most there is.
        yield Reading(f"{share:.0%} clipped: largest coefficient", brightest, 40.0)


def _guard(device):
    """Check that a step whose gradient is NaN changes nothing, and that the next one goes on."""
    trainer = _trainer(device, fields={"schedule.use_cuda_graph": False})  # a hook cannot be recorded
    trainer.step()
    gaussians = trainer.field.gaussians
    before = {name: tensor.clone() for name, tensor in gaussians.tensors().items()}
    hook = gaussians.means.register_hook(lambda gradient: gradient * math.nan)
    trainer.step()
    hook.remove()
    changed = sum(int((before[name] != tensor).sum()) for name, tensor in gaussians.tensors().items())
    skipped, means = trainer.skipped_steps, gaussians.means.clone()
    trainer.step()
    still = bool((means == gaussians.means).all())
    yield count("numbers changed by a step that is not finite", changed)
    yield count("such steps not counted", abs(1 - skipped))
    yield count("steps lost after it", trainer.skipped_steps - skipped + still)


_case = partial(Case, group="training")
TRAINING_CASES = (
    _case("learning-rates", "learning rates up to 1000 times the default", _learning_rates, quick=False),
    _case("gradient-norms", "gradient norms of the loss's terms", _gradient_norms),
    _case("scale-ambiguity", "radiance and exposure known only as a product", _scale_ambiguity),
    _case("opacity-reset", "the steps after opacities are reset", _opacity_reset, quick=False),
    _case("clipped-batches", "photos half clipped, and all but one row", _clipped_batches, quick=False),
    _case("guard", "a step that is not finite", _guard),
)
