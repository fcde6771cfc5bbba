"""Learning rates over a training."""

import pytest

from sehdr_warp.model.gaussians import PARAMETER_NAMES
from sehdr_warp.training.config_files import load_config
from sehdr_warp.training.optimizer import DECAY_EVERY, decay_rates, make_optimizer, set_means_rate

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
