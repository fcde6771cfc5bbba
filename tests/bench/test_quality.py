"""`bench quality` with real trainings, tiny ones: one from the command line, the rest in this process."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.bench import quality_run
from sehdr_warp.bench.methods import METHODS, choose_methods
from sehdr_warp.bench.quality_jobs import Settings, plan_jobs
from sehdr_warp.bench.quality_run import Runner, photos, seconds_to_final, without_training_truth
from sehdr_warp.errors import InputError, SehdrError

from ..make_scenes import write_blender
from ..refusals import call


def job(*names, variants=(), **changes):
    values = {"scenes": ("embedded",), "exposures": (3,), "iterations": (12,), "max_size": 32}
    return plan_jobs(Settings(methods=tuple(choose_methods(names, variants)), **(values | changes)))[0]


def test_the_command_line_trains_evaluates_and_never_repeats(tmp_path, capsys):
    arguments = "--methods default --exposures 2 --iterations 12 --max-size 32 --device cpu --launcher process"
    command = ["bench", "quality", "--out", tmp_path, *arguments.split()]
    for finished in ("0 finished", "1 finished"):
        status, said = call(*command), capsys.readouterr()
        assert status == 0, said.err
        assert finished in said.err and "| default" in said.out
    (line,) = (json.loads(text) for text in (tmp_path / "results.jsonl").read_text().splitlines())
    figures, curve = line["figures"], line["curve"]
    assert figures["protocol"]["gt-max"]["psnr_mu"] > 5 and figures["response"] == "hdr-nerf"
    assert figures["render_fps"] > 0 and figures["peak_memory_bytes"] > 1e7
    assert curve[0]["iteration"] == 1 and curve[-1]["iteration"] == 12 and len(curve) >= 6
    assert [test["seconds"] for test in curve] == sorted(test["seconds"] for test in curve)
    assert 0 < figures["seconds_to_final"] <= figures["train_seconds"]
    (folder,) = (tmp_path / "jobs").iterdir()
    assert not (folder / "run").exists(), "models are kept only on request"


def test_photos_are_made_from_the_truth_at_the_jobs_exposure_and_judged_without_noise():
    dark, bright = (photos(job("default", exposures=(place,), curves=("srgb",)))[0] for place in (1, 3))
    assert bright.views[0].exposure_time == pytest.approx(16 * dark.views[0].exposure_time)
    assert bright.views[0].image.mean() > dark.views[0].image.mean()
    noisy, clean = photos(job("default", curves=("srgb",), noise=(500.0, 5.0)))
    for taken, judged in zip(noisy.views, clean.views, strict=True):
        assert np.array_equal(taken.image, judged.image) == (taken.split == "test")
        assert np.array_equal(taken.hdr, judged.hdr)


def test_only_methods_with_truth_see_that_of_training_views(tmp_path, monkeypatch):
    seen = {}

    def look(scene, out, config, **options):
        seen["train"] = [view.hdr is not None for view in scene.train_views]
        seen["test"] = [view.hdr is not None for view in scene.test_views]
        raise SehdrError("seen enough")

    monkeypatch.setattr(quality_run, "train", look)
    for name, method in METHODS.items():
        with pytest.raises(SehdrError, match="seen enough"):
            Runner("cpu").run(job(name), tmp_path)
        assert set(seen["train"]) == {method.truth} and all(seen["test"]), name


def test_a_scene_without_truth_and_a_training_that_diverges_end_in_one_line(tmp_path):
    write_blender(tmp_path / "photos", 6)
    with pytest.raises(InputError, match="photos: view r_0 has no HDR truth; only scenes with truth"):
        Runner("cpu").run(job("default", scenes=(str(tmp_path / "photos"),)), tmp_path)
    diverging = job("default", iterations=(30,))
    scene, judged = photos(diverging)
    # Exposure times beyond float32 stand in for a training that diverges: every loss is then not finite.
    broken = replace(
        scene,
        views=tuple(replace(v, exposure_time=v.exposure_time * (1e45 if i else 1)) for i, v in enumerate(scene.views)),
    )
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SehdrError, match="not finite"):
        patch.setattr(quality_run, "photos", lambda job: (broken, judged))
        Runner("cpu").run(diverging, tmp_path)


def test_without_training_truth_leaves_the_rest_alone():
    scene, _ = photos(job("default"))
    bare = without_training_truth(scene)
    assert all(view.hdr is None for view in bare.train_views)
    assert all(np.array_equal(a.image, b.image) for a, b in zip(scene.views, bare.views, strict=True))


@pytest.mark.parametrize(
    "psnr,expected",
    [([10, 20, 30, 30.05], 3.0), ([30, 30, 30, 30], 1.0), ([10, 40, 30, 31], 9.0), ([10, 20, 30, 29], 3.0)],
)
def test_seconds_to_final_is_the_first_time_that_stays_within_a_tenth(psnr, expected):
    curve = [{"seconds": seconds, "psnr_mu": value} for seconds, value in zip((1.0, 2.0, 3.0, 9.0), psnr)]
    assert seconds_to_final(curve, 9.0) == expected


@pytest.mark.parametrize(
    "flags,message",
    [
        ("--exposures 5", "exposure 5 is not one of 0 to 4"),
        ("--responses sometimes", "response 'sometimes' is not one of known, blind"),
        ("--methods truth --responses blind", "none of the methods makes sense without the response"),
        ("--scenes nowhere", "nowhere: no such folder"),
        ("--scenes embedded:nowhere", "embedded:nowhere: is not here"),
        ("--curves kodachrome", "kodachrome"),
        ("--workers 0", "--workers 0: not positive"),
        ("--launcher ship", "--launcher ship: not one of auto, slurm, local, process"),
        ("--noise loud", "--noise loud: not one or two numbers"),
        ("--gpus 0", "there are none with --device cpu"),
        ("--seeds one", "--seeds one: not whole numbers"),
        ("--variant a:b", "not NAME:BASE:field=value"),
        ("--slurm gpu", "--slurm gpu: not name=value"),
        ("--report-only", "holds no jobs"),
        ("--report-scenes embedded", "--report-scenes embedded: needs --report-only"),
    ],
)
def test_flags_that_cannot_be_are_refused_in_one_line_before_anything_runs(flags, message, tmp_path, capsys):
    assert call("bench", "quality", "--out", tmp_path / "out", "--device", "cpu", *flags.split()) == 1
    error = capsys.readouterr().err.strip()
    assert message in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()
