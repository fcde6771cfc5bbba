"""Whole trainings of seconds: they learn, they report, they stop tidily, and they refuse what cannot work."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.rasterizer.precompile import training_kernels
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import override_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.scene import codes_of
from sehdr_warp.training import process_settings
from sehdr_warp.training.initialization import make_field, response_for_training
from sehdr_warp.training.run_output import evaluate_views
from sehdr_warp.training.scene_facts import PointFacts
from sehdr_warp.training.train import create_trainer, train
from sehdr_warp.training.trainer import Trainer

from .toy import EXPOSURE_TIME, VARIANTS, make_trainer, quick, toy_scene, with_smaller_photos


@pytest.mark.parametrize(
    ("fields", "part", "antialiased"),
    [({}, 0.5, True), ({"fusion.enabled": True}, 1.0, False), ({}, 1.0, False)],
    ids=["photos of two sizes", "fusion that is left out", "as requested"],
)
def test_kernels_that_the_plan_makes_necessary_are_compiled_ahead(
    tmp_path, monkeypatch, scene, fields, part, antialiased
):
    compiled = []
    monkeypatch.setattr(process_settings, "precompiled", lambda kernels, *_: compiled.extend(kernels) or nullcontext())
    requested = override_config(Config(), {"response.name": "srgb"} | fields)
    with process_settings.precompiling(requested):
        trainer = create_trainer(with_smaller_photos(scene, part), tmp_path / "run", requested, device="cpu")
    assert trainer.field.antialiased == antialiased and not trainer.config.fusion.enabled
    assert set(compiled) >= set(training_kernels(3, antialiased)) and len(set(compiled)) == len(compiled)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_learns_and_loads_as_it_was_trained(scene, trained, variant):
    run = load_run(trained(variant))
    first, last = run.metrics()
    assert first["iteration"] == 10 and last["iteration"] == run.config.schedule.iterations and last["split"] == "test"
    figure = "psnr_mu" if run.config.loss.hdr_weight > 0 else "psnr_ldr"
    # Perceptrons take longer than this to find their weights.
    gain = 0.5 if run.config.fusion.enabled or run.config.response.name == "learned" else 1.5
    assert last[figure] > first[figure] + gain
    assert last["psnr_mu"] > 20 or variant != "default"
    assert last["seconds"] > first["seconds"] > 0
    assert run.base_time == EXPOSURE_TIME and run.gaussian_count == run.summary()["gaussians"]
    assert run.summary()["finished"] and run.summary()["skipped_steps"] == 0
    again = evaluate_views(run.field, scene.test_views, run.config.model.sh_degree)
    assert again["psnr_ldr"] == pytest.approx(last["psnr_ldr"], abs=0.05)
    plain = load_run(trained(variant)).field
    plain.photo_cameras = ()  # Without the filter of views from nearer than the photos, which a training does not have
    again = evaluate_views(plain, scene.test_views, run.config.model.sh_degree)
    assert again["psnr_ldr"] == pytest.approx(last["psnr_ldr"], abs=1e-4)
    assert np.isfinite(run.render(run.cameras[0].camera).hdr.numpy()).all()


@pytest.mark.parametrize("options", [{}, {"mcmc.cap_density": 0.1}, {"densification.cap_max": 50}])
def test_more_start_points_than_the_budget_stay_as_many_and_are_logged(scene, tmp_path, caplog, options):
    """60 points; 0.1 times the square root of six photos of 32 x 32 pixels is 7."""
    caplog.set_level("INFO")
    config = quick(**{"schedule.iterations": 40, "mcmc.growth_rate": 0.5, "model.initial_density": 0.0} | options)
    run = train(scene, tmp_path / "run", config, device="cpu")
    logged_text = caplog.text
    assert ("60 Gaussians are more than the cap of 7" in logged_text) == ("mcmc.cap_density" in options)
    assert ("60 start points: 50 of them are used" in logged_text) == ("densification.cap_max" in options)
    count = run.gaussian_count
    assert count == options.get("densification.cap_max", 60) if options else count > 60


def test_repairs_of_a_response_file_are_logged(scene, tmp_path, caplog):
    caplog.set_level("INFO")
    path = tmp_path / "camera.csv"
    path.write_text("0 0\n0.2 0.5\n0.4 0.7\n0.6 0.6\n1 1\n")
    config = quick(**{"schedule.iterations": 2, "response.name": str(path)})
    for resume in (False, True):
        train(scene, tmp_path / "run", config, device="cpu", resume=resume)
        assert caplog.text.count(f"{path}: 1 of 5 values fall, by up to 0.1; made monotone\n") == 1
        caplog.clear()


def test_the_response_of_linear_photos_is_that_of_simulated_photos_alone(scene, tmp_path, logged):
    linear = replace(scene, light_known=True, response=response_by_name("srgb"))
    for name, photos in (("coded", scene), ("linear", linear)):
        create_trainer(photos, tmp_path / name, quick(**{"response.name": "srgb"}), device="cpu")
    lines = [line for line in logged if line.startswith("response srgb")]
    assert ["only of simulated photos" in line for line in lines] == [False, True]


def test_run_folder_is_complete_and_loads_without_photos(scene, trained):
    run = load_run(trained("default"))
    names = {path.name for path in run.path.iterdir()}
    files = {"config.json", "scene.json", "run.json", "metrics.jsonl", "summary.json", "confidence.safetensors"}
    assert names == files | {"checkpoints", ".lock"}
    assert run.config == quick() and run.data == {"path": "somewhere"}
    assert [entry.name for entry in run.cameras] == [view.name for view in scene.views]
    assert [entry.split for entry in run.cameras] == [view.split for view in scene.views]
    view, size = run.render(scene.test_views[0].camera), scene.views[0].camera.height
    assert view.hdr.shape == (size, size, 3) and view.alpha.shape == view.depth.shape == (size, size)
    solid = view.alpha > 0.9
    assert solid.any() and (view.depth[solid] > 2).all() and (view.depth[solid] < 6).all()
    assert run.summary()["peak_memory_bytes"] > 1e7


def test_views_of_differing_exposure_agree(tmp_path):
    """The same scene photographed at twice the time: one radiance explains both."""
    base = toy_scene()
    srgb, views = response_by_name("srgb"), []
    for index, view in enumerate(base.views):
        time = EXPOSURE_TIME * (2 if index % 2 else 1)
        photo = np.round(srgb.encode(view.hdr * time) * 255).astype(np.float32) / 255
        views.append(replace(view, codes=codes_of(photo), exposure_time=time))
    run = train(replace(base, views=tuple(views)), tmp_path / "run", quick(), device="cpu")
    # Taken for equal, the times would leave the simulated photos a stop off: below 15 dB.
    assert run.metrics()[-1]["psnr_ldr"] > 18
    assert run.metrics()[-1]["psnr_mu"] > 19


def test_clipped_highlights_are_not_pulled_down(scene, tmp_path):
    """Photos of more than the sensor holds: the render is white there, and not held to just white."""
    views = tuple(replace(view, codes=np.full_like(view.codes, 255)) for view in scene.views)
    field = make_field(scene, quick(), response_for_training(scene, quick()), "cpu")
    bound = {"loss.ssim_weight": 0.0, "loss.clipped_smoothness": 0.0, "loss.clipped_estimate": 0.0}
    config = quick(**bound)
    trainer = Trainer(replace(scene, views=views), config, field)
    with torch.no_grad():
        field.gaussians.harmonics_dc.fill_(8.0)
        field.gaussians.opacity_logits.fill_(20.0)
    before = field.gaussians.harmonics_dc.detach().clone()
    for _ in range(5):
        trainer.step()
    # Only edges, where coverage is partial, may ask for more; nothing asks for less.
    assert (field.gaussians.harmonics_dc.detach() - before).min() > -1e-6


def test_existing_files_are_safe(scene, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="is a file"):
        train(scene, tmp_path / "file", quick(), device="cpu")


def test_seeds_decide_and_global_state_does_not(scene, tmp_path):
    config = quick(**{"schedule.iterations": 30})
    results = []
    for index, seed in enumerate((0, 0, 1)):
        torch.manual_seed(index)
        run = train(scene, tmp_path / str(index), override_config(config, {"seed": seed}), device="cpu")
        results.append(run.field.gaussians.means)
    assert torch.equal(results[0], results[1])
    assert results[2].shape != results[0].shape or not torch.equal(results[0], results[2])


@pytest.mark.parametrize("large", [True, False])
def test_new_gaussians_of_a_large_scene_do_not_fade_before_a_photo_shows_them(scene, device, large):
    config = quick(length=60, **{"densification.refine_start_iter": 55, "loss.opacity_weight": 10.0})
    if large:  # A photo shows less than a tenth of the points.
        elsewhere = np.tile(scene.points, (12, 1)) + 1e3
        points = np.concatenate([scene.points, elsewhere])
        scene = replace(scene, points=points, point_colors=np.tile(scene.point_colors, (13, 1)))
    trainer = make_trainer(scene, config, device)
    gaussians = trainer.field.gaussians
    for _ in range(10):
        trainer.step()
    added = gaussians.rows(torch.arange(3, device=device))
    added["means"] = added["means"] + 1e3  # Out of view of all cameras.
    gaussians.append(added, trainer.optimizer)
    trainer.step_runner.invalidate()  # More rows than were reserved, if the scene is large.
    before = gaussians.opacities().detach().clone()
    for _ in range(20):
        trainer.step()
    after = gaussians.opacities().detach()
    assert torch.equal(after[-3:], before[-3:]) == large
    assert after[:3].mean() < 0.9 * before[:3].mean()


@pytest.mark.parametrize("large", [True, False])
def test_gaussians_that_no_photo_shows_shrink_but_in_a_large_scene(scene, device, large):
    config = quick(length=60, **{"loss.size_weight": 0.01})
    field = make_field(scene, config, response_for_training(scene, config), device)
    trainer = Trainer(scene, config, field, point_facts=PointFacts(large_scene=large))
    gaussians = trainer.field.gaussians
    added = gaussians.rows(torch.arange(3, device=device))
    added["means"] = added["means"] + 1e3  # Out of view of all cameras.
    gaussians.append(added, trainer.optimizer)
    trainer.step_runner.invalidate()
    before = gaussians.log_scales.detach().clone()
    for _ in range(10):
        trainer.step()
    shrunk = (before - gaussians.log_scales.detach())[-3:]
    assert not shrunk.any() if large else shrunk.amin() > 0.03


@pytest.mark.parametrize("variant", ["default", "adc"])
def test_gradients_by_harmonics_as_factors_make_the_same_steps(scene, device, variant):
    config = override_config(VARIANTS[variant], {"schedule.sh_degree_interval": 2})
    fields = [make_field(scene, config, response_for_training(scene, config), device) for _ in range(2)]
    for field, deferred in zip(fields, (True, False), strict=True):
        with torch.no_grad():  # How a ball is turned shows in no photo: its gradient would be rounding.
            field.gaussians.log_scales += torch.tensor([-0.5, 0.0, 0.5], device=device)
        trainer = Trainer(scene, config, field)
        trainer.gradient_step.defer_sh_gradients = deferred
        for _ in range(6):
            trainer.step()
    for name, ours in fields[0].gaussians.tensors().items():
        # Adam makes a whole step of a gradient that is rounding: on a GPU, whose sums differ, a few go the other way.
        apart = (ours - fields[1].gaussians.tensors()[name]).abs() > 1e-4 + 1e-3 * ours.abs()
        assert apart.float().mean() < (0.02 if device.startswith("cuda") else 1e-3), name


@pytest.mark.parametrize("value,words", [(0.0, "black"), (1.0, "white")])
def test_photos_without_light_or_shadow_are_refused(scene, tmp_path, value, words):
    views = tuple(replace(view, codes=codes_of(np.full_like(view.image, value))) for view in scene.views)
    with pytest.raises(InputError, match=words):
        train(replace(scene, views=views), tmp_path / "run", quick(), device="cpu")


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_views_are_refused_and_the_folder_stays_as_it_is(scene, tmp_path, count):
    few = replace(scene, views=scene.views[:count])
    with pytest.raises(InputError, match=f"{count} training view"):
        train(few, tmp_path / "run", quick(), device="cpu")
    assert not (tmp_path / "run").exists()
    train(scene, tmp_path / "run", quick(**{"schedule.iterations": 2}), device="cpu")
    with pytest.raises(InputError):
        train(few, tmp_path / "run", quick(), device="cpu", overwrite=True)
    assert load_run(tmp_path / "run").iterations == 2


def test_unknown_device_is_refused(scene, tmp_path):
    for device in ("cuda:99", "tpu", "meta"):
        with pytest.raises(InputError, match=device):
            train(scene, tmp_path / "run", quick(), device=device)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("config", ["demo", {"schedule.iterations": 3, "response.name": "srgb"}, 7])
def test_a_config_may_be_a_name_or_fields(scene, tmp_path, config):
    if config == 7:
        with pytest.raises(InputError, match="is int"):
            create_trainer(scene, tmp_path / "run", config)
        return
    training = create_trainer(scene, tmp_path / "run", config, device="cpu")
    assert training.total == (700 if config == "demo" else 3)
