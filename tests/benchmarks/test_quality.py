"""`python -m benchmarks quality`: jobs and keys, resuming, workers that fail or die, and one real training."""

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import quality
from benchmarks.quality import FAILURE, FORMAT, RESULT, Job, exposed, plan_jobs, run_job, run_jobs
from sehdr_warp.errors import SehdrError
from sehdr_warp.files import write_json
from sehdr_warp.runs.config_files import config_from_dict
from sehdr_warp.training.plan import make_plan

from ..make_scenes import write_blender
from .command_line import call, refused

FINE, DIVERGES, BREAKS, DIES = range(4)
SMALL = ["quality", "--device", "cpu", "--max-size", "32", "--iterations", "12"]


def jobs(methods=("default",), **changes) -> list[Job]:
    return plan_jobs(["embedded"], methods, **{"iterations": 10} | changes)


def made_up(job: Job, psnr: float = 30.0) -> dict:
    """A complete result with plausible figures."""
    hdr = {"psnr_mu": psnr, "ssim_mu": 0.9, "lpips_mu": None}
    figures = {
        "protocol": {name: dict(hdr) for name in ("gt-max", "self-max", "aligned")},
        "ldr": {"psnr": psnr + 1},
        "regions": {
            name: {"fraction": 0.3, "psnr_mu": {"aligned": psnr - 3}} for name in ("clipped", "well-exposed", "dark")
        },
        "lights": {"count": 7, "lost": 0, "energies": [0.8, 1.1]},
        "irradiance": None,
        "confidence": {"spearman_log2": 0.6},
        "response": "srgb",
        **dict.fromkeys(("train_seconds", "renders_per_second"), 2.0),
        **dict.fromkeys(("peak_memory_bytes", "gaussians"), 5000),
        "iterations": 10,
    }
    return {"format": FORMAT, "key": job.key, "shared_by": 1, "config": job.config, "figures": figures}


def run_stub(job, folder, *_):
    """A training that takes no time: the seed says what becomes of a job."""
    with open(folder.parent.parent / "ran.txt", "a") as file:
        file.write(f"{job.config['seed']}\n")
    if job.config["seed"] == DIVERGES:
        raise SehdrError("iteration 7: not finite")
    if job.config["seed"] == BREAKS:
        raise RuntimeError("a defect")
    if job.config["seed"] == DIES:
        os.kill(os.getpid(), signal.SIGKILL)
    return made_up(job)


def ran(out) -> list[int]:
    path = out / "ran.txt"
    return sorted(map(int, path.read_text().split())) if path.exists() else []


def test_jobs_are_every_combination_and_their_keys_tell_them_apart(tmp_path):
    changes = {"exposures": (0, 4), "responses": ("known", "blind"), "seeds": (0, 1)}
    plain = tmp_path / "plain.toml"
    plain.write_text('base = "default"\n[loss]\nclipping = false\nssim_weight = 0.1\n')
    unique_jobs = jobs(("default", "truth", "hdr-gs", str(plain)), **changes)
    # The upper bound learns from truth and hdr-gs learns the curve: blind they would be the same trainings again.
    assert len(unique_jobs) == 2 * 2 * (2 + 1 + 1 + 2)
    assert len({job.key for job in unique_jobs}) == len({job.folder(Path()) for job in unique_jobs}) == len(unique_jobs)
    for job in unique_jobs:
        config, training = job.config, job.config["training"]
        response_name = {"known": "hdr-nerf", "blind": "auto"}.get(config["response"])
        assert response_name is None or training["response"]["name"] == response_name
        assert config["sees_truth"] == (config["method"] == "truth")
        assert training["schedule"]["iterations"] == 10 and "schedule.iterations" in training["plan"]["keep"]
        if config["method"] == "plain":
            assert (training["loss"]["clipping"], training["loss"]["ssim_weight"]) == (False, 0.1)
    assert jobs()[0].key == jobs()[0].key != jobs(max_size=40)[0].key
    assert jobs(iterations=None)[0].config["training"]["schedule"]["iterations"] > 10


def test_every_method_gets_the_same_plan_and_stays_what_it_is(monkeypatch):
    monkeypatch.setenv("SEHDR_THREADS", "4")  # With fewer, methods whose steps take longer may get fewer steps.
    methods = ("default", "3dgs", "truth", "hdr-gs", "paper")
    planned = {}
    for job in jobs(methods, iterations=None, max_size=32):
        scene = exposed(job.place, 32, "hdr-nerf", 2)
        views = tuple(view if job.config["sees_truth"] else replace(view, hdr=None) for view in scene.views)
        config = config_from_dict(job.config["training"], job.label)
        planned[job.config["method"]] = (config, make_plan(replace(scene, views=views), config, "cpu").config)
    default = planned["default"][1]
    for config, plan in planned.values():
        assert plan.schedule.iterations == default.schedule.iterations < 30_000
        for rate in ("means", "means_final", "log_scales", "opacity_logits"):
            assert getattr(plan.optimizer, rate) == getattr(default.optimizer, rate) > getattr(config.optimizer, rate)
        for table in ("form", "ldr_weight", "hdr_weight", "linear_weight"):
            assert getattr(plan.loss, table) == getattr(config.loss, table)
        assert (plan.fusion, plan.response, plan.model) == (config.fusion, config.response, config.model)
    assert planned["paper"][1].fusion.enabled and planned["3dgs"][1].densification.cap_max < 3_000_000


def test_what_cannot_be_planned_is_named(capfd, tmp_path):
    write_blender(tmp_path / "photos", 6)
    for arguments, message in (
        (["--methods", "nope"], "nope: no such preset or file"),
        (["--methods", "default,elsewhere/default.toml"], "two methods have one name"),
        (["--exposures", "5"], "exposure 5 is not one of 0 to 4"),
        (["--responses", "seen"], "response 'seen' is not one of known, blind"),
        (["--methods", "truth", "--responses", "blind"], "there is nothing to train"),
        (["--scenes", tmp_path / "nowhere"], "no such folder"),
        (["--jobs", "0"], "--jobs 0: not positive"),
        (["--slurm", "gpu"], "not NAME=VALUE separated by commas"),
    ):
        command = [*SMALL, "--out", tmp_path / "out", *arguments]
        line = refused(capfd, *command)
        assert message in line, line
    command = [*SMALL, "--out", tmp_path / "out", "--scenes", tmp_path / "photos", "--methods", "default"]
    assert call(*command) == 1
    assert "1 of 1 jobs failed, the first with: " in (line := capfd.readouterr().err) and "no HDR truth" in line


def test_finished_jobs_never_run_again_and_damaged_results_do(tmp_path, monkeypatch):
    monkeypatch.setattr(quality, "run_job", run_stub)
    request = jobs(seeds=(FINE, 7, 8))
    assert [row["gt_max"] for row in run_jobs(request, tmp_path, device="cpu")] == [30.0] * 3
    folders = [job.folder(tmp_path) for job in request]
    whole = (folders[1] / RESULT).read_bytes()
    (folders[1] / RESULT).write_bytes(whole[: len(whole) // 2])
    (folders[2] / RESULT).write_text(json.dumps(json.loads((folders[2] / RESULT).read_text()) | {"key": "other"}))
    assert [job.result(tmp_path) is not None for job in request] == [True, False, False]
    rows = run_jobs(request, tmp_path, device="cpu")
    assert ran(tmp_path) == [FINE, 7, 7, 8, 8] and not any("error" in row for row in rows)


def test_a_job_that_fails_costs_itself_alone_and_is_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(quality, "run_job", run_stub)
    request = jobs(seeds=(DIVERGES, BREAKS, 7))
    rows = run_jobs(request, tmp_path, device="cpu")
    assert [row.get("error") for row in rows] == ["iteration 7: not finite", "RuntimeError: a defect", None]
    run_jobs(request, tmp_path, device="cpu")
    assert ran(tmp_path) == [DIVERGES] * 2 + [BREAKS] * 2 + [7]
    # A success takes the failure of before away.
    write_json(request[0].folder(tmp_path) / RESULT, made_up(request[0]))
    assert not any("error" in row for row in run_jobs(request[:1], tmp_path, device="cpu"))
    assert (request[1].folder(tmp_path) / FAILURE).is_file()


def test_several_jobs_without_submitit_end_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(SehdrError, match="submitit.* is not installed; run `pip install"):
        run_jobs(jobs(seeds=(0, 7)), tmp_path, device="cpu", at_once=2)


def test_only_methods_with_truth_see_that_of_training_views(tmp_path, monkeypatch):
    environments = {}

    def look(scene, out, config, **options):
        environments["train"] = {view.hdr is not None for view in scene.train_views}
        environments["test"] = {view.hdr is not None for view in scene.test_views}
        raise SehdrError("seen enough")

    monkeypatch.setattr(quality, "train", look)
    for name, truth in (("default", False), ("truth", True), ("paper", False), ("hdr-gs-truth", True)):
        with pytest.raises(SehdrError, match="seen enough"):
            run_job(jobs((name,), max_size=32)[0], tmp_path, "cpu", None)
        assert environments == {"train": {truth}, "test": {True}}, name


def test_one_training_from_the_command_line(tmp_path, capsys, few_probes, monkeypatch):
    monkeypatch.setattr(quality, "WARM_UP_ITERATIONS", 2)
    command = [*SMALL, "--methods", "default", "--out", tmp_path / "out", "--json"]
    assert call(*command, tmp_path / "a.json") == 0
    assert "gt-max dB" in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "a.json").read_text())["rows"]
    assert (row["scene"], row["method"], row["response"], row["iterations"]) == ("embedded", "default", "known", 12)
    assert 5 < row["gt_max"] < 60 and row["chosen"] == "hdr-nerf" and row["seconds"] > 0
    assert call(*command, tmp_path / "b.json") == 0
    again = json.loads((tmp_path / "b.json").read_text())["rows"]
    assert again == [row], "a finished job keeps its figures, its seconds among them"
