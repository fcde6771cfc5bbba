"""A training step by step: driven from outside, left at any time, and stopped where its numbers are not finite."""

import gc
import weakref
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.training.matching import Matcher
from sehdr_warp.training.ranks import END, WAIT
from sehdr_warp.training.train import create_trainer
from sehdr_warp.training.training_state import state_of

from .toy import VARIANTS, make_trainer, quick, toy_scene
from .wall_and_lamp import wall_and_lamp


def test_wide_codes_are_intervals_in_the_last_part_alone(scene):
    config = quick(length=20)
    trainer = make_trainer(scene, config)
    widths = []
    for _ in range(20):
        trainer.step()
        table = trainer.data_manager.views[0].target.scale.table[1:-1]
        widths.append(float((table[:, 2] - table[:, 1]).max()))
    assert max(widths[:17]) == 0 < min(widths[17:])


def test_opacities_are_not_pulled_down_once_none_are_relocated(scene):
    config = quick(length=60, **{"densification.refine_stop_iter": 40, "loss.opacity_weight": 10.0})
    trainer = make_trainer(scene, config)
    means = []
    for _ in trainer:
        means.append(float(trainer.field.gaussians.opacities().detach().mean()))
    last_refinement = next(i for i in range(60) if trainer.strategy.schedule.is_over(i))
    assert 20 < last_refinement < 40
    assert means[last_refinement - 1] < 0.5 * means[0] and means[-1] > means[last_refinement - 1]


def test_non_finite_steps_are_skipped_and_then_stop(scene):
    config = quick(**{"mcmc.noise_lr": 0.0})
    trainer = make_trainer(scene, config)
    field = trainer.field
    trainer.step()
    before = field.gaussians.means.detach().clone()
    hook = field.gaussians.harmonics_dc.register_hook(lambda gradient: gradient * float("nan"))
    trainer.step()
    assert trainer.skipped_steps == 1 and torch.equal(before, field.gaussians.means)
    hook.remove()
    trainer.step()
    assert trainer.skipped_steps == 1 and not torch.equal(before, field.gaussians.means)
    field.gaussians.harmonics_dc.register_hook(lambda gradient: gradient * float("inf"))
    with pytest.raises(SehdrError, match="iteration 40: .*more than 20"):
        for _ in range(60):
            trainer.step()
    assert torch.isfinite(field.gaussians.means).all()


def test_a_training_is_driven_step_by_step_and_left_at_any_time(scene, tmp_path):
    training = create_trainer(scene, tmp_path / "run", quick(), device="cpu")
    progress_lines = []
    for step in training:
        progress_lines.append((step.iteration, step.seconds, step.seconds_left))
        if step.iteration == 12:
            before = training.seconds
            assert step.psnr > 5 and training.seconds == before, "a render for the display is no training"
            assert step.loss > 0 and step.gaussians >= 60 and step.total == 90
            break
    assert [iteration for iteration, *_ in progress_lines] == list(range(1, 13))
    assert progress_lines[0][2] is None and 0 < progress_lines[-1][2] < 78 * (
        progress_lines[-1][1] - progress_lines[0][1]
    )
    assert training.run.iterations == 12 and not training.run.summary()["finished"]
    training = create_trainer(scene, tmp_path / "run", device="cpu", resume=True)
    for step in training:
        if step.iteration == 20:
            before = training.run.iterations
            training.stop()
    assert before == 12, "a checkpoint every 30 iterations"
    assert load_run(tmp_path / "run").iterations == training.run.iterations == 20
    assert not RunFolder(tmp_path / "run").confidence.exists(), "that of an earlier checkpoint would not fit"


def test_a_loop_that_is_left_after_the_last_step_ends_as_one_that_is_not(scene, tmp_path):
    trainer = create_trainer(scene, tmp_path / "run", quick(**{"schedule.iterations": 4}), device="cpu")
    for progress in trainer:
        if progress.iteration == progress.total:
            break
    run, saved = trainer.run, load_run(tmp_path / "run")
    assert run.summary()["finished"] and run.field.confidence is not None
    assert torch.equal(run.clipped_share(), saved.clipped_share()), "lights are found in a run as it was trained"


def test_a_finished_trainer_is_evaluated_once(scene, tmp_path):
    trainer = create_trainer(scene, tmp_path / "run", quick(**{"schedule.iterations": 4}), device="cpu")
    metrics = trainer.train().metrics()
    assert trainer.train().metrics() == metrics


def test_a_trainer_that_was_stepped_to_its_end_is_finished_by_train(scene, tmp_path):
    trainer = create_trainer(scene, tmp_path / "run", quick(**{"schedule.iterations": 4}), device="cpu")
    for _ in range(4):
        trainer.step()
    run = trainer.train()
    assert run.metrics()[-1]["iteration"] == 4 and run.summary()["finished"] and run.field.confidence is not None


def test_huge_gradients_leave_finite_parameters(scene):
    """A gradient too large to be squared in float32 would freeze Adam's second moment at infinity."""
    trainer = make_trainer(scene, quick())
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


def test_ranks_that_end_during_a_pause_are_not_asked_again():
    trainer, signals = make_trainer(toy_scene(), VARIANTS["default"]), []
    trainer.ranks = SimpleNamespace(all_reduce_min=lambda signal: signals.append(signal) or END)
    trainer.ranks.check_equal = trainer.ranks.reduce_to_main = trainer.ranks.shutdown = lambda *_: None
    trainer.keep_ranks_waiting()
    assert trainer.ending and not [*trainer] and signals == [WAIT]


def test_a_training_frees_the_matcher_after_the_last_refinement(tmp_path):
    fields = {"schedule.iterations": 90, "plan.enabled": False}
    gc.collect()
    trainer = create_trainer(wall_and_lamp(), tmp_path / "run", load_config("default", fields), device="cpu")
    [matcher], was_over = [weakref.ref(each) for each in gc.get_objects() if isinstance(each, Matcher)], []
    for step in trainer:
        was_over.append(trainer.strategy.schedule.is_over(step.iteration))
        if was_over[-1] and matcher() is not None:
            gc.collect()  # It takes a tenth of a second.
        assert (matcher() is None) == was_over[-1]
    assert was_over[-1] and not was_over[0]
