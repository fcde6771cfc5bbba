"""Files and lines of a training beside its state: figures, checkpoints, log."""

import dataclasses
import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.runs.config_files import override_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.training import gradient_step
from sehdr_warp.training.train import create_trainer, train
from sehdr_warp.training.trainer import Trainer

from .toy import load_unscaled, quick


@pytest.mark.parametrize(
    ("every", "keep", "saved"), [(5000, [], 2), (5001, [], 7), (5000, ["schedule.checkpoint_every"], 7)]
)
def test_checkpoints_are_seconds_apart_unless_their_interval_is_set(scene, tmp_path, every, keep, saved):
    """The default of 5000 iterations of 30,000 are 2 of 12 here; one more is of the start."""
    fields = {"schedule.keep_checkpoints": 9, "schedule.checkpoint_every": every, "plan.keep": keep}
    train(scene, tmp_path / "run", override_config(quick(length=12), fields), device="cpu")
    names = sorted(path.name for path in (tmp_path / "run" / "checkpoints").iterdir())
    assert len(names) == saved and names[-1] == "iteration_00000012", names


def test_tensorboard_gets_the_figures_of_the_last_training_in_a_folder(scene, tmp_path, monkeypatch):
    short = quick(**{"schedule.iterations": 4})
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "torch.utils.tensorboard", None)
        with pytest.raises(SehdrError, match=r"pip install 'sehdr-warp\[tensorboard\]'"):
            train(scene, tmp_path / "without", short, device="cpu", tensorboard=True)
    assert not (tmp_path / "without").exists()
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(scene, tmp_path / "run", quick(length=6), device="cpu", tensorboard=True)
    notes = tmp_path / "run" / "tensorboard" / "notes.txt"
    notes.write_text("mine")
    run = train(scene, tmp_path / "run", short, device="cpu", tensorboard=True, overwrite=True)
    figures = [
        (event.step, event.value) for event in EventAccumulator(str(notes.parent)).Reload().Scalars("test/psnr_ldr")
    ]
    assert figures == [(line["iteration"], pytest.approx(line["psnr_ldr"], abs=1e-3)) for line in run.metrics()]
    assert notes.read_text() == "mine"


def test_held_out_figures_are_logged_in_words(scene, tmp_path, logged):
    short = quick(**{"schedule.iterations": 4})
    last = train(scene, tmp_path / "run", short, device="cpu").metrics()[-1]
    figures = f"held-out photos {last['psnr_ldr']:.1f} dB, HDR {last['psnr_mu']:.1f} dB (mu-law)"
    assert any(line.startswith(f"iteration 4: {figures}, after ") for line in logged)


@pytest.mark.parametrize("excluded", [(3,), (3, 7)])
def test_held_out_photos_that_a_mask_excludes_have_no_figures(scene, tmp_path, excluded):
    nothing = np.zeros((32, 32), np.float32)
    views = tuple(replace(view, mask=nothing) if k in excluded else view for k, view in enumerate(scene.views))
    run = train(replace(scene, views=views), tmp_path / "run", quick(**{"schedule.iterations": 4}), device="cpu")
    assert bool(run.metrics()) == (len(excluded) == 1), "NaN would be left out by every reader"


def test_held_out_photos_that_get_worse_are_named(scene, tmp_path, caplog):
    training = create_trainer(scene, tmp_path / "run", quick(**{"schedule.iterations": 4}), device="cpu")
    training.output.folder.append_metrics({"iteration": 2, "psnr_ldr": 99.0})
    training.train()
    assert "held-out photos scored best at iteration 2 (99.00 dB), now" in caplog.text


@pytest.mark.parametrize("due", ["evaluate", "checkpoint"])
def test_the_device_is_waited_for_before_held_out_photos_are_scored_or_a_state_is_saved(
    scene, tmp_path, monkeypatch, due
):
    """The training's seconds, which both record, must include all of its steps."""
    fields = {"schedule.evaluate_at": [5] if due == "evaluate" else [], "plan.keep": ["schedule.checkpoint_every"]}
    every = {"schedule.checkpoint_every": 5 if due == "checkpoint" else 99}
    training = create_trainer(scene, tmp_path / "run", quick(length=10, **fields, **every), device="cpu")
    calls = []
    monkeypatch.setattr(training, "synchronize", lambda: calls.append("wait"))
    for name in ("evaluate", "checkpoint"):
        monkeypatch.setattr(training.output, name, lambda trainer, name=name: calls.append((name, trainer.iteration)))
    while training.iteration < 9:
        training.step()
        training.output.after_step(training)
    assert calls == ["wait", (due, 5)]


@pytest.mark.parametrize(
    ("earlier", "stays"), [({"train_seconds": 123.0}, True), ({"iteration": 3}, False), (None, False)]
)
def test_a_finished_run_that_is_resumed_keeps_its_summary_if_that_is_of_its_end(scene, tmp_path, earlier, stays):
    train(scene, tmp_path / "run", quick(length=4), device="cpu")
    summary = tmp_path / "run" / "summary.json"
    whole = json.loads(summary.read_text())
    summary.unlink() if earlier is None else summary.write_text(json.dumps(whole | earlier))
    train(scene, tmp_path / "run", device="cpu", resume=True)
    again = json.loads(summary.read_text())
    assert again["iteration"] == 4 and again["finished"]
    assert again["train_seconds"] == (123.0 if stays else whole["train_seconds"])


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
