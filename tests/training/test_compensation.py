"""Trainings on photos whose exposure drifts unsaid."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.scene import codes_of
from sehdr_warp.scene.exposure.compensation import ExposureCompensation
from sehdr_warp.training import matching
from sehdr_warp.training.compensation import estimate_compensation, estimates_compensation
from sehdr_warp.training.initialization import make_matcher
from sehdr_warp.training.matching import at_matching_size
from sehdr_warp.training.train import create_trainer, train

from .wall_and_lamp import WALL, photographed, texture, wall_and_lamp

LINEAR = response_by_name("linear")
CONFIG = load_config("default")
TIMES = (1.0, 0.5, 1.4)
SHORT = {"response.name": "linear", "schedule.iterations": 30, "plan.keep": ("schedule.iterations",)}


def drifting():
    """Photos of differing exposure that say nothing of it."""
    scene = wall_and_lamp(TIMES)
    views = tuple(replace(view, exposure_time=1.0) for view in scene.views)
    return replace(scene, views=views, exposure_times_known=False), [view.exposure_time for view in scene.views]


def found_in(*args):
    result = estimate_compensation(*args)
    return result.compensation, result.decision


def test_drift_is_found_where_there_is_some(device):
    scene, times = drifting()
    drift, _ = found_in(scene, CONFIG, LINEAR, device)
    fitted = np.array([drift.gains[view.name] for view in scene.views])
    np.testing.assert_allclose(
        fitted, np.repeat(np.array(times)[:, None], 3, 1) / np.exp(np.log(times).mean()), rtol=0.03
    )
    matcher = make_matcher(drift.normalize_photos(scene, LINEAR), LINEAR, device)
    assert len(matcher.match(matcher.pixels(400, np.random.default_rng(0))).points) > 200


def test_stated_times_are_doubted_where_photos_contradict_them(device):
    scene, _ = drifting()
    drift, decision = found_in(replace(scene, exposure_times_known=True), CONFIG, LINEAR, device)
    assert drift.stops > 0.4 and "in addition to stated exposure times" in decision.choice and decision.always_log
    assert re.search(r"; 3 photos are brighter or darker than stated \(stops: v_[147] -1\.0, v_", decision.reason)
    right = wall_and_lamp(TIMES)
    # A curve that is not the photos' makes right times look wrong, and compensated photos would not agree.
    for curve in (LINEAR, response_by_name("gamma")):
        drift, decision = found_in(right, CONFIG, curve, device)
        assert drift is None and "do not contradict" in decision.reason


def test_light_that_moves_over_things_is_named_and_is_no_exposure(device):
    """A turned object shows its places in other light in each photo."""

    def light_at(position, rays):
        places = position[:2] + rays[..., :2] / rays[..., 2:] * WALL
        turned = 0.4 * np.sin(4 * places[..., :1] + 5 * position[0] + 7 * position[1])
        return texture(places) * 2 ** (turned + 0.42 * (position[0] > 0.2))

    gains, decision = found_in(replace(photographed(light_at), exposure_times_known=False), CONFIG, LINEAR, device)
    assert gains is None and decision.choice == "none"
    assert re.search(r"differ by 0\.[12]\d stops", decision.reason), decision.reason
    assert "does not make them alike" in decision.reason


def test_stated_times_stay_where_colors_or_corners_alone_drift(device):
    """Cameras state no white balance and no vignetting: exposures are held to what they do state."""
    light = np.linspace(-0.5, 0.5, 9)[:, None] * [1, 0, -1]
    scene = wall_and_lamp()
    views, tinted, darkened = scene.views, [], []
    column, row = np.meshgrid(np.arange(64) - 31.5, np.arange(64) - 31.5)
    corners = 0.5 ** ((column**2 + row**2) / (2 * 32**2))[..., None]
    for view, white_balance in zip(views, light, strict=True):
        tinted.append(replace(view, codes=codes_of(view.image * 2**white_balance, 8)))
        darkened.append(replace(view, codes=codes_of(view.image * corners, 8)))
    drift, decision = found_in(replace(scene, views=tuple(tinted)), CONFIG, LINEAR, device)
    assert (
        "stated exposure times are kept" in decision.choice
        and "white balance" in decision.reason
        and drift.corner_loss == 0
    )
    fitted = np.log2([drift.gains[view.name] for view in views])
    np.testing.assert_allclose(fitted, light, atol=0.06)
    assert (fitted[:, 1] == 0).all()
    drift, decision = found_in(replace(scene, views=tuple(darkened)), CONFIG, LINEAR, device)
    assert (
        "stated exposure times are kept" in decision.choice
        and drift.corner_loss == pytest.approx(0.5, abs=0.1)
        and not drift.stops
    )


def test_vignetting_that_points_do_not_reach_is_left_out_and_named(device):
    """Masks leave the middle of photos, as of a dancer in a studio: the corners would be extrapolated."""
    scene = drifting()[0]
    row, column = np.mgrid[:64, :64] - 31.5
    radius = np.hypot(row, column) / np.hypot(32, 32)
    darkened = [codes_of(view.image * 0.5 ** (radius**2)[..., None], 8) for view in scene.views]
    for reach, note in (
        (0.5, "; vignetting of 9 photos is left out: their points reach 4"),
        (2.0, "towards the corners"),
    ):
        mask = (radius < reach).astype(np.float32)
        views = [replace(view, codes=codes, mask=mask) for view, codes in zip(scene.views, darkened, strict=True)]
        drift, decision = found_in(replace(scene, views=tuple(views)), CONFIG, LINEAR, device)
        assert drift.stops > 0.4 and note in decision.reason
        assert (drift.corner_loss > 0.4) == (reach > 1)


def test_times_that_a_camera_rounds_are_put_right(device):
    """EXIF rounds times and sensitivities: what photos differ by then is less than they differ by otherwise."""
    off = np.array([0.15, -0.2, 0.05, 0.1, -0.1, -0.15, 0.2, 0.0, -0.05])
    scene = wall_and_lamp(TIMES)
    views = [replace(v, exposure_time=v.exposure_time * 2**-e) for v, e in zip(scene.views, off, strict=True)]
    drift, decision = found_in(replace(scene, views=tuple(views)), CONFIG, LINEAR, device)
    assert "in addition to stated exposure times" in decision.choice
    assert not re.search("white balance|than stated", decision.reason), decision.reason
    fitted = np.log2([drift.gains[view.name] for view in views])
    np.testing.assert_allclose(fitted, (off - off.mean())[:, None].repeat(3, 1), atol=0.03)


def test_a_wall_that_is_brighter_from_one_side_is_no_drift(device):
    """Half of the points tell gains by which the other half agree, but harmonics hold such light, in new views too."""

    def light_at(position, rays):
        ahead = rays[..., :2] / rays[..., 2:]
        return 0.5 * texture(position[:2] + ahead * WALL) * 2 ** (2 * ahead[..., :1] - ahead[..., 1:])

    drift, decision = found_in(photographed(light_at, TIMES), CONFIG, LINEAR, device)
    assert drift is None and "do not contradict" in decision.reason


def test_a_lamp_that_moves_is_no_drift(device):
    """Half of the photos are lit from the left, half from the right: no gain of a photo explains it."""

    def light_at(position, rays):
        places = position[:2] + rays[..., :2] / rays[..., 2:] * WALL
        side = 1 if position[1] > 0.1 else -1
        return texture(places) * (0.7 + 0.5 * np.tanh(1.5 * side * places[..., :1]))

    assert estimate_compensation(photographed(light_at), CONFIG, LINEAR, device).compensation is None


def test_a_clear_sky_is_no_drift(device):
    """Matches slide along it, and gains would explain well what little they differ by."""

    def light_at(_, rays):
        away = rays / np.linalg.norm(rays, axis=-1, keepdims=True) - [0.3, 0.2, 0.9]
        return 0.04 + 0.6 * np.exp(-(away**2).sum(-1, keepdims=True) / 0.2) * [0.7, 0.8, 1]

    scene = replace(photographed(light_at, turn=0.3), exposure_times_known=False)
    assert estimate_compensation(scene, CONFIG, LINEAR, device).compensation is None


def test_a_run_keeps_the_gains_and_resumes_on_compensated_photos(tmp_path):
    scene, times = drifting()
    scene = replace(scene, color_matrix=2 * np.eye(3))
    training = create_trainer(scene, tmp_path / "run", SHORT, device="cpu")
    for step in training:
        if step.iteration == 10:
            training.stop()
    run = load_run(tmp_path / "run")
    decision = next(entry for entry in run.decisions() if entry["name"] == "exposure-compensation")
    assert "corrected in the photos" in decision["choice"] and "stops" in decision["reason"]
    compensated = run.normalize_photos(scene)
    assert (run.color_matrix == scene.color_matrix).all()
    ratios = [view.exposure_time / time for view, time in zip(compensated.views, times, strict=True)]
    assert np.ptp(ratios) / np.mean(ratios) < 0.05
    resumed = create_trainer(scene, tmp_path / "run", resume=True, device="cpu")
    for views in (training.scene.views, resumed.scene.views):
        assert [view.exposure_time for view in views] == pytest.approx(
            [view.exposure_time for view in compensated.views]
        )
    for value, known, is_named in (("never", False, False), ("unstated", True, False), ("unstated", False, True)):
        config = load_config("default", {"model.exposure_compensation": value})
        assert estimates_compensation(replace(scene, exposure_times_known=known), config, LINEAR) == is_named


def test_large_photos_are_matched_and_compensated_small(monkeypatch):
    """Full-size copies of a large set, compensated again and again, would take more memory than there is."""
    (scene, _), sizes, even, most = drifting(), [], ExposureCompensation.normalize_photos, 96
    monkeypatch.setattr("sehdr_warp.training.matching.LARGEST_SIDE", most)
    large = tuple(
        replace(view, codes=view.codes.repeat(2, 0).repeat(2, 1), camera=view.camera.resized(128, 128))
        for view in scene.views
    )

    def watched(gains, scene, response):
        sizes.extend(max(view.codes.shape) for view in scene.views)
        return even(gains, scene, response)

    monkeypatch.setattr(ExposureCompensation, "normalize_photos", watched)
    drift, _ = found_in(replace(scene, views=large), CONFIG, LINEAR, "cpu")
    assert drift is not None and max(large[0].codes.shape) > most
    assert sizes and max(sizes) <= most


def test_photos_of_matching_size_stay_as_they_are():
    views = drifting()[0].views
    assert all(small is view for small, view in zip(at_matching_size(views), views, strict=True))


def test_a_resumed_training_seeds_from_the_same_reduced_photos(tmp_path, monkeypatch):
    monkeypatch.setattr(matching, "LARGEST_SIDE", 40)
    scene = drifting()[0]
    config = SHORT | {"densification.refine_start_iter": 0, "densification.refine_stop_iter": 30_000}
    config |= {"schedule.iterations": 50, "mcmc.seed_fraction": 1.0}
    whole = train(scene, tmp_path / "whole", config, device="cpu")
    for progress in create_trainer(scene, tmp_path / "cut", config, device="cpu"):
        if progress.iteration == 10:
            break
    resumed = train(scene, tmp_path / "cut", resume=True, device="cpu")
    assert whole.gaussian_count == resumed.gaussian_count
    assert torch.equal(whole.field.gaussians.means, resumed.field.gaussians.means)
