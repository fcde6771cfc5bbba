"""State of a training: what continues from it, and what does not outlive a change."""

from copy import deepcopy

import pytest
import torch

from sehdr_warp.runs.field import field_from_checkpoint
from sehdr_warp.training.run_output import remove_unseen
from sehdr_warp.training.trainer import Trainer
from sehdr_warp.training.training_state import load_state, state_of

from .toy import VARIANTS, make_trainer


@pytest.mark.parametrize("variant", ["adc", "dropout", "hdr-gs"])
def test_a_trainer_continues_from_its_state(scene, variant):
    config = VARIANTS[variant]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        whole = make_trainer(scene, config)
        _steps(whole, 30)
        state = deepcopy(state_of(whole))
        info = {"response": whole.field.response.to_dict(), "base_time": whole.field.base_time}
        info["normalization"] = whole.field.normalization.to_dict()
        field = field_from_checkpoint(state, config, info)
        state.values["overflowed_steps"] = 3
        resumed = Trainer(scene, config, field)
        load_state(resumed, state)
        for trainer in (whole, resumed):
            _steps(trainer, 25)
    finally:
        torch.set_num_threads(threads)
    again = state_of(resumed).tensors
    for name, value in state_of(whole).tensors.items():
        assert torch.equal(value, again[name]), name
    assert resumed.overflowed_steps == 3, "overflows are summed over all sessions, as skipped steps are"


def test_statistics_of_gaussians_do_not_outlive_the_removal_of_some(scene):
    trainer = make_trainer(scene, VARIANTS["adc"])
    _steps(trainer, 30)
    count = trainer.field.gaussians.count
    assert trainer.strategy.state_dict(count)
    with torch.no_grad():
        trainer.field.gaussians.opacity_logits[0] = -20.0
    remove_unseen(trainer)
    assert trainer.field.gaussians.count < count and not trainer.strategy.state_dict(count - 1)
    _steps(trainer, 25)  # Over a refinement.


def _steps(trainer, count):
    for _ in range(count):
        trainer.step()
