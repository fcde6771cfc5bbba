"""N steps equal N/2, an end without warning, resume, N/2: bit for bit on the CPU."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.runs.config_files import load_config, override_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.runs.run_writer import RunWriter
from sehdr_warp.training.run_output import evaluate_views
from sehdr_warp.training.train import create_trainer, train

from ..refusals import call
from .toy import VARIANTS, quick, toy_scene, without_truth
from .wall_and_lamp import wall_and_lamp


@pytest.mark.parametrize("variant", ["adc", "default", "paper"])
def test_resume_is_exact(scene, trained, tmp_path, variant):
    blind = without_truth(scene)
    shutil.copytree(trained(variant).parent / "killed", tmp_path / "killed")
    assert RunFolder(tmp_path / "killed").newest_checkpoint().values["iteration"] == 60
    # The statistics of a densification interval that the kill cut in two (50 to 75) are part of the state.
    run = train(blind, tmp_path / "killed", device="cpu", resume=True)
    whole = RunFolder(trained(variant)).newest_checkpoint()
    resumed = RunFolder(tmp_path / "killed").newest_checkpoint()
    assert run.config == VARIANTS[variant] and resumed.values["iteration"] == run.config.schedule.iterations
    assert whole.tensors.keys() == resumed.tensors.keys()
    for name, value in whole.tensors.items():
        assert torch.equal(value, resumed.tensors[name]), name
    for name in ("order", "skipped_steps"):
        assert whole.values[name] == resumed.values[name]
    assert [line["iteration"] for line in run.metrics()] == [10, run.iterations], "each evaluation once"
    # Of a finished run nothing changes, its figures neither.
    before = run.summary() | {"device": "another", "overflowed_steps": 7}
    run.folder.summary_file.write_text(json.dumps(before))
    again = train(blind, tmp_path / "killed", VARIANTS[variant], device="cpu", resume=True)
    assert torch.equal(run.field.gaussians.means, again.field.gaussians.means) and run.metrics() == again.metrics()
    assert again.summary() == before


def test_a_large_scene_stays_one_in_a_training_that_goes_on_without_its_points(scene, tmp_path):
    """Bare photos of a run are loaded with its cameras, without the points by which a scene counts as large."""
    points = np.random.default_rng(0).uniform([-1, -1, 19], [1, 1, 21], (2000, 3))  # Above all photos
    large = replace(without_truth(scene), points=points, point_colors=np.full((2000, 3), 0.5, np.float32))
    bare = replace(large, points=points[:0], point_colors=large.point_colors[:0])
    create_trainer(large, tmp_path / "large", quick(), device="cpu")
    create_trainer(bare, tmp_path / "bare", quick(), device="cpu")
    resumed = (create_trainer(bare, tmp_path / name, device="cpu", resume=True) for name in ("large", "bare"))
    assert [trainer.large_scene for trainer in resumed] == [True, False]


def test_a_training_that_goes_on_without_its_points_is_exact(tmp_path):
    """Its seeds take the depths of the start."""
    bare, config = wall_and_lamp(), quick(**{"densification.cap_max": 900})
    points = np.random.default_rng(0).uniform([-1, -1, 0.5], [1, 1, 0.7], (500, 3))
    scene = replace(bare, points=points, point_colors=np.full((500, 3), 0.5, np.float32))
    for step in create_trainer(scene, tmp_path / "whole", config, device="cpu"):
        if step.iteration == 66:
            shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    train(bare, tmp_path / "cut", device="cpu", resume=True)
    whole, cut = (RunFolder(tmp_path / name).newest_checkpoint() for name in ("whole", "cut"))
    assert all(torch.equal(value, cut.tensors[name]) for name, value in whole.tensors.items())


def test_a_run_begins_with_a_checkpoint_of_its_start(scene, trained, tmp_path):
    scene = without_truth(scene)
    begun = create_trainer(scene, tmp_path / "cut", VARIANTS["adc"], device="cpu")
    assert RunFolder(tmp_path / "cut").newest_checkpoint().values["iteration"] == 0
    with pytest.raises(InputError, match="another training is at work"):
        train(scene, tmp_path / "cut", device="cpu", resume=True)
    del begun
    again, whole = train(scene, tmp_path / "cut", device="cpu", resume=True), load_run(trained("adc"))
    assert torch.equal(whole.field.gaussians.means, again.field.gaussians.means)
    assert len(again.metrics()) == len(whole.metrics())


def copy_at_each_change(monkeypatch, folder: Path, place: Path) -> list[Path]:
    """Copy the folder before each later change of the disk: it holds what a kill there would leave."""
    copies, at_it = [], []

    def copying(function):
        def call(*arguments, **options):
            if not at_it:
                at_it.append(True)
                copies.append(shutil.copytree(folder, place / str(len(copies))))
                at_it.clear()
            return function(*arguments, **options)

        return call

    for name in ("rename", "replace", "unlink", "rmdir", "mkdir", "fsync"):
        monkeypatch.setattr(os, name, copying(getattr(os, name)))
    return copies


def test_a_run_is_replaced_whole_or_not_at_all(scene, trained, tmp_path, monkeypatch):
    """At any change of the disk the old run or the new one is there, and what is another's stays."""
    scene = without_truth(scene)
    out, old = shutil.copytree(trained("adc"), tmp_path / "run"), load_run(trained("adc"))
    others = "notes.txt", "checkpoints/iteration_best"
    for name in others:
        (out / name).write_text("mine")
    settings = [out / name for name in ("orientation.json", "light_unit.json")]
    for path in settings:  # What other commands stated about the earlier scene.
        path.write_text("{}")
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: 1 << 30)  # By a process that is gone.
        copies = copy_at_each_change(patch, out, tmp_path)
        train(scene, out, quick(seed=5, **{"schedule.iterations": 8}), device="cpu", overwrite=True)
    assert not any(path.exists() for path in settings)
    ends = []
    for place, copy in enumerate(copies):
        try:
            run = load_run(copy)
        except InputError:  # Half replaced: readers change nothing, and the next training finishes it.
            RunWriter(copy).check_start(resume=True, overwrite=False)
            run = load_run(copy)
            assert run.config.seed == 5
        ends.append((run.config.seed, run.iterations))
        assert run.config.seed == 5 or torch.equal(run.field.gaussians.means, old.field.gaussians.means)
        assert [(copy / name).read_text() for name in others] == ["mine", "mine"]
        if place % 12 == 5:
            # A new run that is complete but not in place yet is put there by the training that resumes.
            assert train(scene, copy, device="cpu", resume=True).iterations in (run.config.schedule.iterations, 8)
            assert [path.name for path in copy.rglob(".*") if path.name != ".lock"] == []
    assert ends == sorted(ends) and {(0, 90), (5, 0)} < {*ends} and len({*ends[5::12]}) > 1


def test_resume_refuses_another_config_or_scene(scene, tmp_path):
    short = quick(**{"schedule.iterations": 5})
    train(scene, tmp_path / "run", short, device="cpu")
    with pytest.raises(InputError, match="seed = 0, but 1"):
        train(scene, tmp_path / "run", override_config(short, {"seed": 1}), device="cpu", resume=True)
    with pytest.raises(InputError, match="views differ"):
        train(toy_scene(view_count=6), tmp_path / "run", short, device="cpu", resume=True)


def test_a_run_that_was_left_in_its_moving_average_goes_on_with_more_iterations(tmp_path):
    """The number of Gaussians changes again before the average of the longer training begins."""
    config = quick(**{"densification.cap_max": 5000})
    trainer = create_trainer(toy_scene(), tmp_path / "run", config, device="cpu")
    for progress in trainer:
        if progress.iteration == 89:
            break
    assert trainer.average.means
    longer = override_config(config, {"schedule.iterations": 180})
    resumed = create_trainer(toy_scene(), tmp_path / "run", longer, device="cpu", resume=True)
    count = resumed.field.gaussians.count
    assert resumed.train().iterations == 180 and resumed.field.gaussians.count != count


def test_resuming_with_the_same_config_keeps_the_length_of_the_run(scene, tmp_path):
    """The planned one, and that to which it was stretched later."""
    config = load_config("default", {"model.initial_density": 4.0, "mcmc.cap_density": 4.0})

    def resumed(config):
        trainer = create_trainer(scene, tmp_path / "run", config, device="cpu", resume=True)
        trainer.output.folder.unlock()
        return trainer

    trainer = create_trainer(scene, tmp_path / "run", config, device="cpu")
    planned = trainer.total
    assert planned < config.schedule.iterations
    for _ in trainer:
        break
    assert resumed(config).total == planned
    longer = override_config(trainer.config, {"schedule.iterations": planned + 9})
    assert resumed(longer).total == resumed(config).total == planned + 9
    named = override_config(config, {"schedule.iterations": planned + 50, "plan.keep": ["schedule.iterations"]})
    assert resumed(named).total == planned + 50


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_a_preset_does_not_stretch_a_run_of_fewer_iterations(preset, photos, tmp_path):
    words = ["train", photos, "--device", "cpu", "--response", "srgb", "--preset", preset, "--out", tmp_path / "run"]
    assert call(*words, "--iterations", 3) == 0
    assert call(*words, "--resume") == 0
    assert RunFolder(tmp_path / "run").read_config().schedule.iterations == 3
    assert call(*words, "--resume", "--iterations", 4) == call(*words, "--resume") == 0
    assert RunFolder(tmp_path / "run").read_config().schedule.iterations == 4


def test_a_preset_in_python_does_not_stretch_a_run_and_stated_iterations_do(scene, tmp_path, logged):
    train(scene, tmp_path / "run", load_config("fast", {"schedule.iterations": 3}), device="cpu")
    file = tmp_path / "fast.toml"
    file.write_text('base = "fast"\n')
    for config in ("fast", file):
        assert train(scene, tmp_path / "run", config, device="cpu", resume=True).iterations == 3
    assert sum("the run keeps its 3 iterations, not the preset's 1500" in line for line in logged) == 2
    longer = load_config("fast", {"schedule.iterations": 4})
    assert train(scene, tmp_path / "run", longer, device="cpu", resume=True).iterations == 4
    assert any("the finished training goes on from 3 to 4 iterations" in line for line in logged)
    train(scene, tmp_path / "fields", {"schedule.iterations": 2}, device="cpu")
    stated = (({"seed": 0}, 2), ({"schedule.iterations": 3}, 3), ({"schedule": {"iterations": 4}}, 4))
    for fields, iterations in stated:
        assert train(scene, tmp_path / "fields", fields, device="cpu", resume=True).iterations == iterations


def test_a_finished_training_that_goes_on_for_much_longer_loses_nothing_first(scene, trained, tmp_path):
    """And an interruption changes no bit of it, although it is not the schedule of its config."""
    longer, runs = override_config(VARIANTS["default"], {"schedule.iterations": 250}), []
    for name, stops in (("whole", ()), ("cut", (130, 170))):
        shutil.copytree(trained("default"), tmp_path / name)
        for stop in (*stops, 250):
            trainer = create_trainer(without_truth(scene), tmp_path / name, longer, device="cpu", resume=True)
            before = evaluate_views(trainer.field, scene.train_views, trainer.degree)["psnr_ldr"]
            count = trainer.field.gaussians.count
            assert trainer.degree == 1
            for step in trainer:
                assert step.gaussians == count
                if step.iteration in (100, 190):
                    after = evaluate_views(trainer.field, scene.train_views, trainer.degree)["psnr_ldr"]
                    assert after > before - 0.3
                if step.iteration == stop < 250:
                    trainer.stop()
            assert load_run(tmp_path / name).degree == 1
        runs.append(RunFolder(tmp_path / name).newest_checkpoint())
    whole, cut = runs
    assert all(torch.equal(value, cut.tensors[name]) for name, value in whole.tensors.items())


@pytest.mark.parametrize(("total", "densifies"), [(250, False), (900, True)])
def test_densification_begins_again_after_a_trial_alone(scene, trained, tmp_path, total, densifies):
    shutil.copytree(trained("default"), tmp_path / "run")
    longer = override_config(VARIANTS["default"], {"schedule.iterations": total})
    for config in (longer, None):
        trainer = create_trainer(without_truth(scene), tmp_path / "run", config, device="cpu", resume=True)
        trainer.output.folder.unlock()
        assert any(map(trainer.strategy.is_due, range(trainer.iteration + 1, total))) == densifies


def test_a_field_that_a_damaged_plan_invents_is_named_with_the_file(scene, tmp_path):
    config = load_config("demo", {"schedule.iterations": 2, "plan.enabled": True})
    create_trainer(scene, tmp_path / "run", config, device="cpu").output.folder.unlock()
    file = RunFolder(tmp_path / "run").plan_file
    plan = json.loads(file.read_text())
    plan["decisions"][0]["fields"] = {"model.colour": 1}
    file.write_text(json.dumps(plan))
    with pytest.raises(InputError, match=r"plan\.json: unknown field model\.colour = 1"):
        create_trainer(scene, tmp_path / "run", config, device="cpu", resume=True)


def test_resuming_names_other_fields_that_have_the_same_values(scene, tmp_path):
    first = load_config("demo", {"schedule.iterations": 3, "plan.keep": ["schedule.iterations"]})
    train(scene, tmp_path / "run", first, device="cpu")
    again = load_config("demo", {"schedule.iterations": 5, "plan.keep": ["schedule.iterations", "seed"]})
    assert train(scene, tmp_path / "run", again, device="cpu", resume=True).iterations == 5


def test_a_run_of_an_earlier_version_is_refused_in_one_line(scene, tmp_path):
    run = train(scene, tmp_path / "run", quick(**{"schedule.iterations": 1}), device="cpu")
    info = json.loads(run.folder.info_file.read_text())
    run.folder.info_file.write_text(json.dumps(info | {"format": 1}))
    for use in (load_run, lambda path: train(scene, path, device="cpu", resume=True)):
        with pytest.raises(InputError, match="format = 1 is of sehdr-warp .* this one reads format 3; train again"):
            use(run.path)


@pytest.mark.parametrize(
    ("table", "field", "now"), [("model", "order_angle", 25.0), ("loss", "transmittance_weight", 0.1)]
)
def test_a_run_of_an_earlier_version_goes_on_without_new_fields(scene, tmp_path, table, field, now):
    """Runs of version 0.3 do not state them, and were trained as by 0."""
    blind, places = without_truth(scene), []
    for name, value in (("stated", 0.0), ("older", 0.0), ("new", now)):
        config = quick(**{"schedule.iterations": 5, f"{table}.{field}": value})
        create_trainer(blind, tmp_path / name, config, device="cpu").output.folder.unlock()
        if name == "older":
            folder = RunFolder(tmp_path / name)
            values = json.loads(folder.config_file.read_text())
            del values[table][field]
            folder.config_file.write_text(json.dumps(values))
            (file,) = folder.path.glob("checkpoints/*/*.json")
            file.write_text(json.dumps(json.loads(file.read_text()) | {"run": folder.hashes()}))
        run = train(blind, tmp_path / name, device="cpu", resume=True)
        places.append(run.field.gaussians.means)
        assert run.config.model_dump()[table][field] == value
    assert torch.equal(places[0], places[1]) and not torch.equal(places[0], places[2])


def test_resume_refuses_another_response_before_photos_are_read(photos, tmp_path, capsys, monkeypatch):
    words = ["train", photos, "--out", tmp_path / "run", "--device", "cpu"]
    assert call(*words, "--iterations", "1", "--response", "learned") == 0
    monkeypatch.setattr("sehdr_warp.runs.open.load_scene_and_log_notes", None)
    assert call("train", "--resume", "--out", tmp_path / "run", "--device", "cpu", "--response", "srgb") == 1
    assert "response.name = 'learned', but 'srgb' was asked for" in capsys.readouterr().err


def test_photos_that_moved_are_asked_for_and_taken_from_their_new_place(photos, tmp_path, capsys):
    moved, run = tmp_path / "moved photos", tmp_path / "my run"
    shutil.copytree(photos, moved)
    assert call("train", moved, "--out", run, "--device", "cpu", "--iterations", "1", "--response", "srgb") == 0
    moved.rename(tmp_path / "new place")
    resume = "--resume", "--out", run, "--device", "cpu", "--iterations", "2"
    assert call("train", *resume) == 1
    problem = f"{moved}: the photos of the run are no longer here; say where they are: sehdr-warp train SCENE --resume"
    assert f"{problem} --out '{run}'" in capsys.readouterr().err
    assert call("train", tmp_path / "new place", *resume) == 0
    assert load_run(run).iterations == 2
    assert call("eval", run, "--device", "cpu") == 0, "the run states the new place"


def test_a_summary_is_of_the_last_checkpoint(scene, tmp_path):
    config = quick(**{"schedule.iterations": 4})
    run = train(scene, tmp_path / "run", config, device="cpu")
    before = run.summary()
    run.folder.summary_file.write_text(json.dumps(before | {"iteration": 2, "finished": False}))  # Of a killed session.
    assert train(scene, run.path, device="cpu", resume=True).summary()["finished"]
    longer = override_config(config, {"schedule.iterations": 8})
    trainer = create_trainer(scene, run.path, longer, device="cpu", resume=True)
    trainer.stop()
    assert not trainer.train().summary()["finished"]


def test_a_resumed_training_takes_the_runs_response(photos, tmp_path, logged):
    words = ["train", photos, "--out", tmp_path / "run", "--device", "cpu"]
    assert call(*words, "--iterations", "4") == 0
    assert any("choosing the response" in line for line in logged)
    logged.clear()
    assert call("train", "--resume", "--out", tmp_path / "run", "--device", "cpu", "--iterations", "6") == 0
    assert load_run(tmp_path / "run").iterations == 6 and not any("choosing" in line for line in logged)
