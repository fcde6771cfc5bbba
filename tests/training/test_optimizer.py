"""Learning rates over a training, and the moving average that it ends with."""

import pytest
import torch

from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.optimizer import load_optimizer_tensors, make_optimizer, optimizer_tensors

from .toy import VARIANTS, toy_field


@pytest.mark.parametrize(("iterations", "batch", "interval"), [(4000, 1, 2), (3999, 1, 1), (8000, 2, 2), (7999, 2, 1)])
def test_harmonics_step_in_turn_where_there_are_steps_enough(iterations, batch, interval):
    config = load_config("default", {"schedule.iterations": iterations})
    assert make_optimizer(toy_field(), config, batch).sh_update_interval == interval


def test_rates_and_decays_follow_the_batch():
    config, field = VARIANTS["adc"], toy_field()
    one, four = (make_optimizer(field, config, batch) for batch in (1, 4))
    for a, b in zip(one.param_groups, four.param_groups, strict=True):
        assert b["lr"] == pytest.approx(2 * a["lr"])
    assert four.betas == pytest.approx([beta**4 for beta in one.betas])
    field.gaussians.means.grad = torch.ones_like(field.gaussians.means)
    four.step()
    saved = optimizer_tensors(four, 4)
    assert saved["means.0.step"] == 4
    load_optimizer_tensors(one, saved, 1)
    assert one.state[field.gaussians.means]["step"] == 4
