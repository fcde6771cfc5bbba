"""A training that diverges: what is skipped, what is saved, and where it goes on."""

import dataclasses

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.training import gradient_step
from sehdr_warp.training.train import create_trainer, train
from sehdr_warp.training.trainer import Trainer
from sehdr_warp.training.training_state import state_of

from .toy import load_unscaled, make_trainer


def config(**overrides):
    values = {"schedule.iterations": 30, "schedule.checkpoint_every": 10}
    return load_unscaled("demo", {**values, "schedule.evaluate_at": [30], **overrides})


def after(monkeypatch, iteration, change):
    """Calls change(trainer) once, after a step."""
    step = Trainer.step

    def stepped(self):
        step(self)
        if self.iteration == iteration:
            change(self)

    monkeypatch.setattr(Trainer, "step", stepped)


def test_a_state_that_is_not_finite_is_never_saved_and_resume_goes_back(scene, tmp_path, monkeypatch):
    def spoil(trainer):
        with torch.no_grad():
            trainer.field.gaussians.means[0] = float("nan")

    whole = train(scene, tmp_path / "whole", config(), device="cpu")
    with monkeypatch.context() as patch:
        after(patch, 15, spoil)
        with pytest.raises(SehdrError, match="iteration 20: gaussians.means is not finite .*resume=True"):
            train(scene, tmp_path / "run", config(), device="cpu")
    assert RunFolder(tmp_path / "run").newest_checkpoint().values["iteration"] == 10
    run = train(scene, tmp_path / "run", device="cpu", resume=True)
    assert torch.equal(run.field.gaussians.means, whole.field.gaussians.means)


def test_while_the_loss_is_not_finite_the_last_checkpoint_stays(scene, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(Trainer, "loss", property(lambda self: float("inf") if self.iteration == 20 else 0.1))
    train(scene, tmp_path / "run", config(**{"schedule.keep_checkpoints": 9}), device="cpu")
    assert "iteration 20: the loss is inf; no checkpoint is written" in caplog.text
    names = sorted(path.name for path in (tmp_path / "run" / "checkpoints").iterdir())
    assert names == ["iteration_00000000", "iteration_00000010", "iteration_00000030"]


@pytest.mark.parametrize("end", [15, 30])
def test_the_last_state_is_saved_though_its_step_was_skipped(scene, tmp_path, monkeypatch, end):
    """Beside 60 Gaussians, five that no photo shows: they are removed at the end, and the confidence is of the rest."""
    points = np.concatenate([scene.points, np.full((5, 3), 1e3)])
    colors = np.concatenate([scene.point_colors, np.ones((5, 3), np.float32)])
    larger = dataclasses.replace(scene, points=points, point_colors=colors)
    options = config(**{"model.initial_density": 0.0, "densification.cap_max": 65})
    trainer = create_trainer(larger, tmp_path / "run", options, device="cpu")
    loss = gradient_step.data_loss
    monkeypatch.setattr(
        gradient_step, "data_loss", lambda *args: loss(*args) * (float("nan") if trainer.iteration == end else 1)
    )
    for progress in trainer:
        if progress.iteration == end:
            trainer.stop()
    run = load_run(tmp_path / "run")
    assert trainer.skipped_steps == 1 and run.iterations == end
    assert run.gaussian_count == (65 if end == 15 else 60)
    assert end == 15 or run.metrics()[-1]["gaussians"] == 60, "the last score is that of the saved Gaussians"


def test_huge_gradients_leave_finite_parameters(scene):
    """A gradient too large to be squared in float32 would freeze Adam's second moment at infinity."""

    options = config()
    trainer = make_trainer(scene, options)
    field = trainer.field
    factor = [1e36]
    field.gaussians.harmonics_dc.register_hook(lambda gradient: gradient * factor[0])
    trainer.step()
    assert trainer.skipped_steps == 1
    factor[0] = 1.0
    before = field.gaussians.harmonics_dc.detach().clone()
    trainer.step()
    assert trainer.skipped_steps == 1 and not torch.equal(before, field.gaussians.harmonics_dc)
    assert all(
        bool(tensor.isfinite().all()) for tensor in state_of(trainer).tensors.values() if tensor.is_floating_point()
    )
