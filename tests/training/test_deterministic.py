"""A training that repeats bit for bit, on a GPU too."""

import pytest
import torch

from sehdr_warp.training.train import train

from .toy import load_unscaled

SHORT = {
    "schedule.iterations": 14,
    "schedule.sh_degree_interval": 4,
    "densification.refine_start_iter": 4,
    "densification.refine_stop_iter": 12,
    "densification.refine_every": 4,
    "adc.reset_every": 8,
    "deterministic": True,
}


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_two_trainings_are_the_same_bits(scene, tmp_path, device, preset):
    overrides = SHORT | ({"response.name": "srgb"} if preset == "paper" else {})
    config = load_unscaled(preset, overrides)
    runs = [train(scene, tmp_path / name, config, device=device) for name in "ab"]
    assert not torch.are_deterministic_algorithms_enabled()
    assert runs[0].field.deterministic
    first, second = (run.field.gaussians.tensors() for run in runs)
    assert first["means"].shape == second["means"].shape
    for name, values in first.items():
        assert torch.equal(values, second[name]), name
