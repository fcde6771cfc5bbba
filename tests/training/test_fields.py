"""Fields of the config that no other test changes: each changes what is trained."""

from functools import cache

import pytest
import torch

from sehdr_warp.runs.config_files import override_config
from sehdr_warp.training.process_settings import torch_settings

from .toy import make_trainer, quick

EARLY = {
    f"densification.{name}": value
    for name, value in (("refine_start_iter", 1), ("refine_stop_iter", 44), ("refine_every", 20))
}
EARLY |= {"adc.reset_every": 20, "schedule.sh_degree_interval": 4}
BASE = {
    "mcmc": quick(length=45, **EARLY),
    "adc": quick(
        length=45, **EARLY | {"densification.strategy": "adc", "loss.opacity_weight": 0.0, "mcmc.noise_lr": 0.0}
    ),
}
FIELDS = [
    ("mcmc", "model.antialiased", True),
    ("mcmc", "optimizer.means_final", 1e-3),
    ("mcmc", "optimizer.log_scales", 0.05),
    ("mcmc", "optimizer.quaternions", 0.01),
    ("mcmc", "optimizer.opacity_logits", 0.1),
    ("mcmc", "optimizer.harmonics_rest", 0.01),
    ("mcmc", "densification.prune_opacity", 0.3),
    ("mcmc", "loss.size_weight", 1.0),
    ("mcmc", "loss.transmittance_weight", 0.0),
    ("mcmc", "mcmc.sharpness_photos", 2),
    ("adc", "densification.prune_opacity", 0.3),
    ("adc", "adc.grow_grad2d", 5e-3),
    ("adc", "adc.grow_scale3d", 1.0),
    ("adc", "adc.prune_scale3d", 0.04),
]


@pytest.fixture(scope="module")
def end(scene):
    """end(strategy, ...): what is trained, after all its steps, with a field changed or none."""

    @cache
    def train(strategy, *changed):
        config = override_config(BASE[strategy], dict([changed] if changed else []))
        with torch_settings(deterministic=False):
            trainer = make_trainer(scene, config)
            for _ in range(config.schedule.iterations):
                trainer.step()
        return torch.cat([tensor.flatten() for tensor in trainer.field.gaussians.tensors().values()]).detach()

    return train


@pytest.mark.parametrize("strategy, field, value", FIELDS)
def test_a_field_has_an_effect(end, strategy, field, value):
    assert not torch.equal(end(strategy, field, value), end(strategy))


@pytest.mark.parametrize("strategy", BASE)
def test_what_is_no_change_has_none(end, strategy):
    assert torch.equal(end(strategy, "schedule.keep_checkpoints", 2), end(strategy))
