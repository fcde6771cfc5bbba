"""`bench quality` without trainings: plans, workers that die, results that are damaged, tables."""

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from filelock import FileLock

from sehdr_warp.bench import quality_pool
from sehdr_warp.bench.methods import METHODS, Method, choose_methods
from sehdr_warp.bench.quality import bench_quality
from sehdr_warp.bench.quality_jobs import RESULT, Settings, plan_jobs, read_failure, read_result, write_job
from sehdr_warp.bench.quality_plot import error_over_time, pareto_front
from sehdr_warp.bench.quality_pool import Workers, run_jobs, slurm_parameters
from sehdr_warp.bench.quality_report import RESULTS, write_quality_report
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.files import write_json

from ..refusals import call
from . import quality_stub as stub

ROOT = Path(__file__).resolve().parents[2]
PROCESS = Workers(launcher="process")


def settings(**changes) -> Settings:
    values = {"scenes": ("embedded",), "methods": (METHODS["default"],), "exposures": (2,), "iterations": (10,)}
    return Settings(**(values | changes))


@pytest.fixture
def stubbed(monkeypatch):
    """Workers are real processes, but those of quality_stub.py."""

    def start(command, **options):
        assert command[1:3] == ["-m", "sehdr_warp.bench.quality_worker"]
        return subprocess.Popen([sys.executable, "-m", "tests.bench.quality_stub", command[3]], cwd=ROOT, **options)

    stand_in = type("subprocess", (), {"Popen": staticmethod(start), "DEVNULL": subprocess.DEVNULL,
                                       "TimeoutExpired": subprocess.TimeoutExpired})  # fmt: skip
    monkeypatch.setattr(quality_pool, "subprocess", stand_in)
    monkeypatch.setattr(quality_pool, "POLL_SECONDS", 0.05)


def ran(out) -> list[str]:
    path = out / "ran.txt"
    return path.read_text().split() if path.exists() else []


def test_jobs_are_every_combination_and_their_keys_tell_them_apart():
    methods = tuple(choose_methods(["default", "truth"], ["plain:default:loss.clipping=false,model.antialiased=true"]))
    asked = settings(methods=methods, exposures=(0, 4), responses=("known", "blind"), seeds=(0, 1), iterations=(10, 20))
    jobs = plan_jobs(asked)
    # The upper bound learns from truth: without the response it would be the same training again.
    assert len(jobs) == 2 * 2 * 2 * (2 * 2 + 1)
    assert len({job.key for job in jobs}) == len({job.name for job in jobs}) == len(jobs)
    assert [job.key for job in plan_jobs(asked)] == [job.key for job in jobs]
    for job in jobs:
        training = job.config["training"]
        assert training["response"]["name"] == {"known": "hdr-nerf", "blind": "auto"}[job.config["response"]]
        assert training["seed"] == job.config["seed"]
    plain = next(job for job in jobs if job.config["method"]["name"] == "plain").config
    assert plain["method"]["base"] == "default"
    assert (plain["training"]["loss"]["clipping"], plain["training"]["model"]["antialiased"]) == (False, True)


@pytest.mark.parametrize("responses", [("known",), ("blind",), ("known", "blind"), ("blind", "known", "blind")])
def test_a_method_that_learns_the_response_is_trained_once(responses):
    chosen = choose_methods(["hdr-gs", "gauss-hdr", "default"], ["own:default:response.name=learned"])
    jobs = plan_jobs(settings(methods=tuple(chosen), responses=responses))
    trained = [(job.config["method"]["name"], job.config["response"]) for job in jobs]
    others = [("default", response) for response in dict.fromkeys(responses)]
    assert sorted(trained) == sorted([(name, "learned") for name in ("hdr-gs", "gauss-hdr", "own")] + others)
    # Which of the two was asked for does not make it another training.
    keys = {job.key for job in jobs if job.config["response"] == "learned"}
    known = plan_jobs(settings(methods=tuple(chosen), responses=("known",)))
    assert keys == {job.key for job in known if job.config["response"] == "learned"}


def test_a_folder_of_truth_is_known_by_its_files_not_by_its_place(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name / "room").mkdir(parents=True)
        (tmp_path / name / "room" / "view.exr").write_bytes(b"light")
    first, second = (plan_jobs(settings(scenes=(str(tmp_path / name / "room"),)))[0] for name in ("a", "b"))
    assert first.key == second.key
    (tmp_path / "b" / "room" / "view.exr").write_bytes(b"shade")
    assert plan_jobs(settings(scenes=(str(tmp_path / "b" / "room"),)))[0].key != first.key
    with pytest.raises(SehdrError, match="one name; rename"):
        plan_jobs(settings(scenes=(str(tmp_path / "a" / "room"), str(tmp_path / "b" / "room"))))


@pytest.mark.parametrize(
    "names,variants,message",
    [
        (["sedhr"], [], "method 'sedhr' is unknown; choose from default, paper"),
        ([], [], "no method is asked for"),
        (["default", "default"], [], "asked for twice"),
        (["default"], ["x:default"], "not NAME:BASE:field=value"),
        (["default"], ["default:paper:seed=1"], "asked for twice"),
        (["missing.toml"], [], "missing.toml: no such file"),
    ],
)
def test_methods_that_cannot_be_are_refused_in_one_line(names, variants, message):
    with pytest.raises(SehdrError, match=message):
        choose_methods(names, variants)


def test_variants_from_the_command_line_and_from_a_file(tmp_path):
    (tmp_path / "v.toml").write_text(
        '[calm]\nbase = "paper"\nloss.ssim_weight = 0.5\nfusion.exposures = ["1x", "4x"]\n'
    )
    given = 'sure:default:fusion.exposures=["1/8x", "8x"],response.method=paper'
    sure, calm = choose_methods([], [given], tmp_path / "v.toml")
    assert sure == Method("sure", "default", base="default",
                          overrides={"fusion.exposures": ["1/8x", "8x"], "response.method": "paper"})  # fmt: skip
    assert (calm.base, calm.overrides) == ("paper", {"loss.ssim_weight": 0.5, "fusion.exposures": ["1x", "4x"]})
    with pytest.raises(InputError, match="loss.clip"):
        plan_jobs(settings(methods=tuple(choose_methods([], ["odd:default:loss.clip=true"]))))


def test_what_was_repaired_in_the_file_of_a_curve_is_told(tmp_path, stubbed):
    path = tmp_path / "camera.csv"
    path.write_text("0 0\n0.2 0.5\n0.4 0.7\n0.6 0.6\n1 1\n")
    lines = []
    bench_quality(settings(curves=("srgb", str(path))), tmp_path / "out", PROCESS, progress=lines.append)
    assert [line for line in lines if "made monotone" in line] == [
        f"{path}: 1 of 5 values fall, by up to 0.1; made monotone"
    ]


def test_failures_cost_one_job_each_and_are_said_in_one_line(tmp_path, stubbed):
    asked = settings(seeds=(stub.DIVERGES, stub.DIES, stub.BREAKS, stub.FINE, 7, 8))
    lines = []
    text, failure = bench_quality(asked, tmp_path, Workers(count=2, launcher="process"), progress=lines.append)
    assert str(failure).startswith("3 of 6 jobs failed, the first with: iteration 7: 21 steps")
    jobs = plan_jobs(asked)
    errors = [read_failure(tmp_path / "jobs" / job.name) for job in jobs]
    assert [error is not None for error in errors] == [True, True, True, False, False, False]
    assert "its worker died (signal 9)" in errors[1]["error"] and errors[2]["error"] == "RuntimeError: out of memory"
    assert len(lines) == 1 + 6 and sum("FAILED" in line for line in lines) == 3
    assert len(ran(tmp_path)) == 6
    assert text + "\n" == (tmp_path / "quality.md").read_text()
    assert "3 failed:" in text and "seed 1: iteration 7: 21 steps" in text
    assert len((tmp_path / RESULTS).read_text().splitlines()) == 3
    # The same command again: what failed is tried again, what is finished is not.
    assert "3 of 6 jobs failed" in str(bench_quality(asked, tmp_path, PROCESS)[1])
    assert len(ran(tmp_path)) == 9


def test_a_result_cut_short_is_run_again_and_no_other(tmp_path, stubbed):
    asked = settings(seeds=(0, 7, 8))
    bench_quality(asked, tmp_path, PROCESS)
    folders = [tmp_path / "jobs" / job.name for job in plan_jobs(asked)]
    whole = (folders[1] / RESULT).read_bytes()
    (folders[1] / RESULT).write_bytes(whole[: len(whole) // 2])
    (folders[2] / RESULT).write_text(json.dumps(json.loads((folders[2] / RESULT).read_text()) | {"key": "other"}))
    assert [read_result(folder) is not None for folder in folders] == [True, False, False]
    (tmp_path / RESULTS).write_text("{cut")
    bench_quality(asked, tmp_path, PROCESS)
    assert ran(tmp_path)[3:] == [folders[1].name, folders[2].name]
    assert len([json.loads(line) for line in (tmp_path / RESULTS).read_text().splitlines()]) == 3


def test_a_killed_run_resumes_and_waits_for_the_job_that_its_worker_still_has(tmp_path, stubbed):
    asked = settings(seeds=(7, stub.SLOW))
    jobs = plan_jobs(asked)
    # A worker of a run that was killed: it has a job's lock and an attempt of a run that is gone.
    folder = write_job(tmp_path, jobs[1])
    write_json(folder / "attempt.json", {"run": "gone", "worker": "gone-0", "pid": 1})
    lock = FileLock(folder / "lock")
    lock.acquire()

    def finish():
        time.sleep(1.5)
        write_json(folder / RESULT, stub.result(jobs[1]))
        lock.release()

    thread, lines = threading.Thread(target=finish), []
    thread.start()
    bench_quality(asked, tmp_path, PROCESS, progress=lines.append)
    thread.join()
    assert any("waiting for a worker of an earlier run" in line for line in lines)
    assert ran(tmp_path) == [jobs[0].name], "the other was finished by the worker that had it"


def test_one_run_in_a_folder_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(quality_pool, "LOCK_SECONDS", 0.1)
    with FileLock(tmp_path / "run.lock"), pytest.raises(InputError, match="another `bench quality` is at work"):
        run_jobs(plan_jobs(settings()), tmp_path, PROCESS, "cpu", lambda line: None)


def test_workers_that_cannot_start_end_the_run(tmp_path, stubbed, monkeypatch):
    monkeypatch.setattr(quality_pool, "write_json", lambda *arguments, **options: None)  # no plan for them to read
    with pytest.raises(SehdrError, match="workers die before they take a job .exit status 1.; see .*log"):
        run_jobs(plan_jobs(settings()), tmp_path, PROCESS, "cpu", lambda line: None)


def test_submitit_starts_workers_that_finish(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setattr(quality_pool, "work", _finish_everything)
    monkeypatch.setattr(quality_pool, "POLL_SECONDS", 0.05)
    asked = settings(seeds=(0, 7))
    assert bench_quality(asked, tmp_path, Workers(launcher="local"))[1] is None
    assert all(read_result(tmp_path / "jobs" / job.name) for job in plan_jobs(asked))


def _finish_everything(**arguments):
    from sehdr_warp.bench import quality_worker

    quality_worker._runner = lambda plan: stub.StubRunner()
    return quality_worker.work(**arguments)


def test_without_submitit_workers_are_processes_and_slurm_is_refused(monkeypatch):
    monkeypatch.setattr(quality_pool.importlib.util, "find_spec", lambda name: None)
    assert Workers().cluster is None
    with pytest.raises(SehdrError, match=r"pip install sehdr-warp\[bench\]"):
        _ = Workers(launcher="slurm").cluster


def test_slurm_gives_each_worker_a_gpu_of_its_own(monkeypatch):
    monkeypatch.setattr(quality_pool.importlib.util, "find_spec", lambda name: object())
    workers = Workers(count=4, gpus=(0,), launcher="slurm", slurm={"partition": "gpu", "time": "90"})
    assert slurm_parameters(workers) == {"gpus_per_node": 1, "timeout_min": 90, "slurm_partition": "gpu"}
    assert workers.shared_by == 1
    assert Workers(count=4, gpus=(0, 1), launcher="process").shared_by == 2


def test_workers_take_gpus_in_turn_among_the_visible(tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")
    workers = Workers(count=3, gpus=(0, 1), launcher="process")
    given = [quality_pool._arguments(tmp_path, workers, place, "w")["gpu"] for place in range(3)]
    assert given == ["4", "6", "4"]


def results_in(out, *entries):
    """Job folders with results: (method, psnr, seconds, changes of Settings)."""
    for method, psnr, seconds, changes in entries:
        for job in plan_jobs(settings(methods=(method,), **changes)):
            write_json(write_job(out, job) / RESULT, stub.result(job, psnr, seconds), overwrite=True)


def table(text: str, column: str) -> tuple[list[str], dict[str, list[str]]]:
    """Titles and rows, by their first cell, of the first table that has a column."""
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] if line.startswith("|") else [] for line in text.splitlines()
    ]
    start = next(place for place, row in enumerate(rows) if column in row)
    end = next((place for place in range(start, len(rows)) if not rows[place]), len(rows))
    return rows[start], {row[0]: row for row in rows[start + 2 : end]}


def test_tables_pair_each_job_with_the_upper_bound_and_with_its_base(tmp_path):
    variant = choose_methods([], ["plain:default:loss.clipping=false"])[0]
    results_in(
        tmp_path,
        (METHODS["default"], 30.0, 2.0, {"exposures": (1,)}),
        (METHODS["default"], 20.0, 4.0, {"exposures": (2,)}),
        (METHODS["truth"], 31.0, 3.0, {"exposures": (1,)}),
        (METHODS["truth"], 25.0, 3.0, {"exposures": (2,)}),
        (variant, 29.0, 2.0, {"exposures": (1,)}),
    )
    text = write_quality_report(tmp_path)
    assert text + "\n" == (tmp_path / "quality.md").read_text()
    titles, lines = table(text, "gt-max")
    line = dict(zip(titles[:7], lines["default"]))
    assert (line["jobs"], line["gt-max"], line["worst"], line["to U"]) == ("2", "25.00", "20.00", "-3.00")
    assert list(lines) == ["default", "plain", "truth"]
    titles, lines = table(text, "clipped")
    assert dict(zip(titles, lines["default"]))["confidence"] == "0.50"
    ablation = next(line for line in text.splitlines() if line.startswith("| plain") and "loss.clipping" in line)
    assert [c.strip() for c in ablation.split("|")][1:5] == ["plain", "default", "1", "-1.00"]
    assert (tmp_path / "error-over-time-cpu.png").read_bytes()[:4] == b"\x89PNG"


def section(text: str, heading: str) -> str:
    return text.partition(f"## {heading}\n")[2].partition("\n## ")[0]


def test_a_learned_response_stands_under_known_and_under_blind(tmp_path):
    both = {"responses": ("known", "blind")}
    results_in(tmp_path, (METHODS["default"], 30.0, 2.0, both), (METHODS["hdr-gs"], 20.0, 2.0, both))
    text = write_quality_report(tmp_path)
    assert text.count("## ") == 2 and "3 trainings" in text
    for response in ("known", "blind"):
        _, lines = table(section(text, f"cpu, hdr-nerf, response {response}"), "gt-max")
        assert {name: line[1:3] for name, line in lines.items()} == {
            "default": ["1", "30.00"],
            "hdr-gs": ["1", "20.00"],
        }
    assert "one training stands under known and under blind: hdr-gs." in text


def test_a_learned_response_alone_has_a_table_of_its_own(tmp_path):
    results_in(tmp_path, (METHODS["hdr-gs"], 20.0, 2.0, {}))
    text = write_quality_report(tmp_path)
    assert text.count("## ") == 1 and "## cpu, hdr-nerf, response learned" in text


def test_each_exposure_has_its_difference_to_the_upper_bound(tmp_path):
    for place, (default, truth) in enumerate([(30.0, 31.0), (20.0, 25.0), (28.0, None)]):
        results_in(tmp_path, (METHODS["default"], default, 2.0, {"exposures": (place,)}))
        if truth is not None:
            results_in(tmp_path, (METHODS["truth"], truth, 2.0, {"exposures": (place,)}))
    text = write_quality_report(tmp_path)
    for protocol in ("gt-max", "aligned"):
        titles, lines = table(text, f"{protocol} (to U)")
        assert titles[1:] == ["exposure 0", "exposure 1", "exposure 2"]
        assert lines["default"][1:] == ["30.00 (-1.00)", "20.00 (-5.00)", "28.00"]
        assert lines["truth"][1:] == ["31.00 (+0.00)", "25.00 (+0.00)", "-"]


def test_tables_of_chosen_scenes_alone(tmp_path, capsys):
    for scene, psnr in (("embedded:study", 30.0), ("embedded:night", 20.0), ("embedded:glass", 10.0)):
        results_in(tmp_path, (METHODS["default"], psnr, 2.0, {"scenes": (scene,)}))
    asked = ["bench", "quality", "--out", tmp_path, "--report-only", "--report-scenes"]
    assert call(*asked, "study,embedded:night") == 0
    text = (tmp_path / "quality-study-night.md").read_text()
    assert capsys.readouterr().out == text
    assert table(text, "gt-max")[1]["default"][1:4] == ["2", "25.00", "20.00"]
    assert "2 scenes (embedded:night, embedded:study)" in text and not (tmp_path / RESULTS).exists()
    assert call(*asked, "study,attic") == 1
    known = "choose from embedded:glass, embedded:night, embedded:study"
    assert f"has no result of scene attic; {known}" in capsys.readouterr().err


def test_of_two_results_for_one_place_the_newer_counts(tmp_path):
    results_in(tmp_path, (METHODS["default"], 30.0, 2.0, {}))
    changed = Method("default", "default", overrides={"loss.ssim_weight": 0.3})
    job = plan_jobs(settings(methods=(changed,)))[0]
    write_json(write_job(tmp_path, job) / RESULT, stub.result(job, 40.0, date="2026-11-22T00:00:00+00:00"))
    text = write_quality_report(tmp_path)
    assert "40.00" in text and "30.00" not in text
    assert "1 results of configs that have changed since are left out" in text


def test_error_over_time_and_its_front():
    rows = [{"curve": [{"seconds": 1.0, "psnr_mu": 10.0}, {"seconds": 100.0, "psnr_mu": 30.0}]},
            {"curve": [{"seconds": 2.0, "psnr_mu": 20.0}, {"seconds": 10.0, "psnr_mu": 20.0}]}]  # fmt: skip
    seconds, psnr = error_over_time(rows, count=100)
    assert (seconds[0], seconds[-1]) == pytest.approx((2.0, 100.0))
    # At 10 s the first is half way on the log scale, and the second has ended and keeps its figure.
    assert psnr[abs(seconds - 10).argmin()] == pytest.approx((20 + 20) / 2, abs=0.2)
    assert psnr[-1] == pytest.approx((30 + 20) / 2)
    import numpy as np

    front = pareto_front([(np.array([1.0, 3.0]), np.array([5.0, 9.0])), (np.array([2.0, 4.0]), np.array([4.0, 8.0]))])
    assert [tuple(point) for point in np.transpose(front)] == [(1.0, 5.0), (3.0, 9.0)]
