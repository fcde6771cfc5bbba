"""Learning rates over a training."""

from math import nan

import pytest
import torch

from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.optimizer import guarded_step, make_optimizer

from .toy import toy_field


@pytest.mark.parametrize("incomplete", [None, False, True])
@pytest.mark.parametrize("bad", [False, True])
def test_a_guarded_step_is_made_or_left_out_whole(device, incomplete, bad):
    field = toy_field().to(device)
    optimizer = make_optimizer(field, load_config("default"), 1.0)
    means = field.gaussians.means
    before = means.detach().clone()
    loss = (means * (nan if bad else 1.0)).sum()
    loss.backward()
    flag = None if incomplete is None else torch.tensor(incomplete, device=device)
    step_counters = torch.zeros(3, dtype=torch.int64, device=device)
    step = guarded_step(optimizer, loss, flag, step_counters=step_counters)
    assert step_counters.tolist() == [bad, 0, 0]
    assert bool(step) == (not bad and not incomplete)
    assert torch.equal(means, before) == (not bool(step))
    assert float(optimizer.state[means]["step"]) == float(step)


@pytest.mark.parametrize(("iterations", "batch", "interval"), [(4000, 1, 2), (3999, 1, 1), (8000, 2, 2), (7999, 2, 1)])
def test_harmonics_step_in_turn_where_there_are_steps_enough(iterations, batch, interval):
    config = load_config("default", {"schedule.iterations": iterations})
    assert make_optimizer(toy_field(), config, 1.0, batch).sh_update_interval == interval
