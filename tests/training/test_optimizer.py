"""Learning rates over a training."""

from math import nan

import pytest
import torch

from sehdr_warp.field.gaussians import PARAMETER_NAMES
from sehdr_warp.training.config_files import load_config
from sehdr_warp.training.optimizer import (
    DECAY_EVERY,
    decay_rates,
    guarded_step,
    make_optimizer,
    set_means_rate,
)

from .toy import toy_field

OPTIONS = {"schedule.iterations": 1000, "optimizer.final_factor": 0.01, "optimizer.decay_from": 0.6}


def rates(iteration, **options):
    config = load_config("default", OPTIONS | options)
    optimizer = make_optimizer(toy_field(), config, 1.0)
    set_means_rate(optimizer, 0.125)
    decay_rates(optimizer, config, iteration)
    return {group["name"]: group["lr"] for group in optimizer.param_groups}


def test_rates_fall_exponentially_at_the_end():
    plain = load_config("default").optimizer
    for iteration, factor in ((1, 1.0), (600, 1.0), (800, 0.1), (1000, 0.01)):
        found = rates(iteration)
        for name in set(PARAMETER_NAMES) - {"means"}:
            assert found[name] == pytest.approx(factor * getattr(plain, name)), (name, iteration)
        assert found["means"] == 0.125


def test_a_resumed_training_has_the_rates_of_the_last_change():
    assert rates(800 + DECAY_EVERY - 1) == rates(800) != rates(800 + DECAY_EVERY)


def test_rates_stay_without_a_final_factor():
    plain = load_config("default").optimizer
    assert rates(1000, **{"optimizer.final_factor": 1.0})["harmonics_dc"] == plain.harmonics_dc


@pytest.mark.parametrize("incomplete", [None, False, True])
@pytest.mark.parametrize("bad", [False, True])
def test_a_guarded_step_is_made_or_left_out_whole(device, incomplete, bad):
    field = toy_field().to(device)
    optimizer = make_optimizer(field, load_config("default"), 1.0)
    means = field.gaussians.means
    before = means.detach().clone()
    loss = (means * (nan if bad else 1.0)).sum()
    loss.backward()
    told = None if incomplete is None else torch.tensor(incomplete, device=device)
    nonfinite, made = guarded_step(optimizer, loss, told)
    assert bool(nonfinite) == bad
    assert bool(made) == (not bad and not incomplete)
    assert torch.equal(means, before) == (not bool(made))
    assert float(optimizer.state[means]["step"]) == float(made)
