"""Steps on more rows than there are Gaussians, as recorded ones are: the same training, and nothing moves."""

import pytest
import torch

from sehdr_warp.runs.config_files import override_config
from sehdr_warp.training import step_runner
from sehdr_warp.training.strategies import base
from sehdr_warp.training.training_state import state_of

from .recorded import captured
from .toy import VARIANTS, make_trainer


def trained_steps(scene, config, device, reserves):
    """A trainer after 60 steps, and how often its Gaussians moved in how many changes of their number."""
    training = make_trainer(scene, config, device)
    training.step_runner.reserves_rows, gaussians, moves = reserves, training.field.gaussians, []
    for _ in range(60):
        count, before = gaussians.count, gaussians.reallocations
        training.step()
        if gaussians.count != count:
            moves.append(gaussians.reallocations > before)
    return training, moves


@pytest.mark.parametrize("variant", ["default", "adc"])
def test_reserved_rows_change_nothing_of_a_training(scene, device, variant, monkeypatch):
    monkeypatch.setattr(base, "RESERVE_FACTOR", 8.0)  # So few Gaussians become many at once.
    monkeypatch.setattr(step_runner, "MAX_RESERVE", 8.0)
    config = override_config(VARIANTS[variant], {"deterministic": True, "schedule.use_cuda_graph": False})
    (plain, all_moved), (roomy, moved) = (trained_steps(scene, config, device, reserves) for reserves in (False, True))
    assert all(all_moved) and not any(moved) and len(moved) == len(all_moved) > 1
    assert roomy.field.gaussians.row_count > roomy.field.gaussians.count
    assert state_of(roomy).values == state_of(plain).values
    for name, expected in plain.field.gaussians.tensors().items():
        # Not in every bit: torch takes the last of a tensor's numbers, and a GPU sums, otherwise.
        apart = (roomy.field.gaussians.tensors()[name] - expected).abs() > 1e-4 + 1e-3 * expected.abs()
        assert apart.float().mean() < 0.05, name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")
def test_recorded_steps_go_on_through_changes_and_wait_only_where_the_count_grows(scene, monkeypatch):
    monkeypatch.setattr(base, "RESERVE_FACTOR", 8.0)
    monkeypatch.setattr(step_runner, "MAX_RESERVE", 8.0)
    monkeypatch.setattr(step_runner, "MIN_HEADROOM", 0.0)
    config = VARIANTS["default"]
    training = make_trainer(scene, config, "cuda:0")
    for _ in range(48):
        training.step()
    recorded, count = captured(training), training.field.gaussians.count
    assert recorded is not None
    try:
        for _ in range(10):
            refines = training.strategy.is_due(training.iteration + 1)
            torch.cuda.set_sync_debug_mode("default" if refines else "error")
            training.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert training.field.gaussians.count > count and captured(training) is recorded
