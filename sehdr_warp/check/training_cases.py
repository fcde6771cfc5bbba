"""The catalogue's training: where it diverges, what the guards do, and what resets and clipped batches do to it."""

import math

import numpy as np
import torch

from ..response import response_by_name
from ..training.config import Config
from ..training.config_files import load_config
from ..training.initialization import make_field
from ..training.losses import data_loss, regularised
from ..training.targets import training_views
from ..training.trainer import Trainer
from .case import Case, Reading, count, not_finite
from .toy import EXPOSURE_TIME, toy_field, toy_scene

TRAINING = "training"
STEPS = 40


def _config(**changes) -> Config:
    """A short training; changes: dotted fields with __ for the dot."""
    overrides = {name.replace("__", "."): value for name, value in changes.items()}
    # Without changes of the Gaussians, their number or their places.
    still = {"densification.start": 30_000, "densification.noise": 0.0}
    given = {"schedule.iterations": STEPS, "schedule.harmonics_every": 30_000, "schedule.evaluate_at": [30_000]}
    return load_config("default", given | still | {"seed": 1} | overrides)


def _trainer(device, clipped: float = 0.0, **changes) -> Trainer:
    scene, config = toy_scene(clipped), _config(**changes)
    return Trainer(scene, config, make_field(scene, config, response_by_name("srgb"), device))


def _state_not_finite(trainer: Trainer) -> int:
    return not_finite(*(tensor for tensor in trainer.state()[0].values() if tensor.is_floating_point()))


def _learning_rates(device):
    """All learning rates times 1, 10, 100 and 1000: the loss relative to the start's, and what stays finite."""
    readings = []
    for factor in (1, 10, 100, 1000):
        rates = {
            f"optimizer__{name}": min(1.0, getattr(Config().optimizer, name) * factor)
            for name in ("means", "log_scales", "quaternions", "opacity_logits", "harmonics_dc", "harmonics_rest")
        }
        trainer = _trainer(device, **rates)
        trainer.step()
        first = trainer.loss
        losses = []
        while trainer.iteration < STEPS:
            trainer.step()
            losses.append(trainer.loss)
        readings.append(count(f"rates x {factor}: numbers of the state not finite", _state_not_finite(trainer)))
        # At its own rates a training must descend. Far above, the loss of encoded values must stay bounded.
        last = float(np.mean(losses[-8:])) / first
        readings.append(Reading(f"rates x {factor}: last loss / first", last, 0.8 if factor == 1 else 3.0))
    return readings


def _gradient_norms(device):
    """The norm of each loss term's gradient by each parameter: finite, and none drowns the photo's by 1e4."""
    field = _trainer(device).field
    view = training_views(toy_scene().train_views, field.base_time, device, truth=False)[0]
    plain = {"loss.ssim_weight": 0.0}
    terms = {
        "L1": plain,
        "L1 and SSIM": {},
        "opacity": plain | {"loss.opacity_weight": 0.01},
    }
    norms, broken = {}, 0
    for name, changes in terms.items():
        config = load_config("default", changes).loss
        photo = field.photograph(view.camera, view.exposure_time)
        field.zero_grad(set_to_none=True)
        regularised(data_loss(field, photo, view.target, config), field, config).backward()
        gradients = [p.grad for p in field.gaussians.parameters() if p.grad is not None]
        broken += not_finite(*gradients)
        norms[name] = math.sqrt(sum(float(gradient.square().sum()) for gradient in gradients))
    readings = [Reading(f"{name}: gradient / L1's", norm / norms["L1"], 1e4) for name, norm in norms.items()]
    return [*readings, count("gradients not finite", broken)]


def _scale_ambiguity(device):
    """Exposure and radiance appear only as a product: the photo of radiance k at time t / k is the photo at t.

    With a fixed response that direction is exactly flat; a free response would add its own. The base time takes it out:
    colours are exposures at that time.
    """
    readings = []
    for factor in (2.0**-20, 1e-3, 1e3, 2.0**20):
        photos = []
        for scale in (1.0, factor):
            field = toy_field(device, EXPOSURE_TIME * scale)
            camera = toy_scene().train_views[0].camera
            photos.append(field.render_ldr(camera, EXPOSURE_TIME * scale).double())
        error = float((photos[0] - photos[1]).abs().max())
        readings.append(Reading(f"photo at base time x {factor:.3g}", error, 2.0**-22))
    return readings


def _opacity_reset(device):
    """The steps after a reset of all opacities to 0.01: finite, and the loss is back within twice its value before."""
    trainer = _trainer(device)
    while trainer.iteration < STEPS // 2:
        trainer.step()
    before = trainer.loss
    with torch.no_grad():
        low = math.log(0.01 / 0.99)
        trainer.field.gaussians.opacity_logits.clamp_(max=low)
        trainer.field.gaussians.forget("opacity_logits", slice(None), trainer.optimizer)
    losses = []
    for _ in range(60):
        trainer.step()
        losses.append(trainer.loss)
    return [
        count("steps skipped", trainer.skipped_steps),
        count("numbers of the state not finite", _state_not_finite(trainer)),
        Reading("worst loss after the reset / before", max(losses) / before, 100.0),
        Reading("loss 60 steps later / before", float(np.mean(losses[-6:])) / before, 2.0),
    ]


def _clipped_batches(device):
    """Photos of which a half and all but one row are clipped: no step is lost, and nothing runs away."""
    readings = []
    for share in (0.5, 0.97):
        trainer = _trainer(device, clipped=share)
        while trainer.iteration < STEPS:
            trainer.step()
        brightest = float(trainer.field.gaussians.harmonics_dc.detach().abs().max())
        readings += [
            count(f"{share:.0%} clipped: steps skipped", trainer.skipped_steps),
            count(f"{share:.0%} clipped: numbers not finite", _state_not_finite(trainer)),
            # A clipped pixel says `at least white`: from a start near white, 40 steps of 0.02 are the most there is.
            Reading(f"{share:.0%} clipped: largest coefficient", brightest, 40.0),
        ]
    return readings


def _guard(device):
    """A step whose gradient is NaN changes nothing; the next one goes on."""
    trainer = _trainer(device)
    trainer.step()
    before = {name: tensor.clone() for name, tensor in trainer.field.gaussians.tensors().items()}
    hook = trainer.field.gaussians.means.register_hook(lambda gradient: gradient * math.nan)
    trainer.step()
    hook.remove()
    if trainer._recorder is not None:
        trainer._recorder.invalidate()  # the hook is in the recording
    after = {name: tensor.clone() for name, tensor in trainer.field.gaussians.tensors().items()}
    changed = sum(int((before[name] != after[name]).sum()) for name in before)
    skipped = trainer.skipped_steps
    trainer.step()
    moved = int((after["means"] != trainer.field.gaussians.means).sum())
    return [
        count("numbers changed by a step that is not finite", changed),
        count("such steps not counted", abs(1 - skipped)),
        count("steps lost after it", trainer.skipped_steps - skipped + (moved == 0)),
    ]


CASES = (
    Case("learning-rates", TRAINING, "learning rates up to 1000 times the default", _learning_rates, quick=False),
    Case("gradient-norms", TRAINING, "gradient norms of the loss's terms", _gradient_norms),
    Case("scale-ambiguity", TRAINING, "radiance and exposure known only as a product", _scale_ambiguity),
    Case("opacity-reset", TRAINING, "the steps after opacities are reset", _opacity_reset, quick=False),
    Case("clipped-batches", TRAINING, "photos half clipped, and all but one row", _clipped_batches, quick=False),
    Case("guard", TRAINING, "a step that is not finite", _guard),
)
