"""A survey trained in blocks through the command line: jobs, kills, merging, and uses of the merged run."""

import json
import re
import signal
import sys

import numpy as np
import pytest
import torch

from sehdr_warp.blocks import jobs
from sehdr_warp.blocks.block_plan import BlockPlan
from sehdr_warp.blocks.job import folder_of
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.splats import read_gaussians

from ..refusals import call, refused

submitit = pytest.importorskip("submitit")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
FLAGS = ["--device", "cpu", "--response", "srgb", "--iterations", "150", "--preset", "fast"]


@pytest.fixture(scope="module")
def merged(survey, interrupt, tmp_path_factory):
    """Trained in two blocks; the process of the first is killed once."""
    out = tmp_path_factory.mktemp("merged") / "run"
    killer = interrupt(out / "blocks" / "block_01", signal.SIGKILL)
    assert call("train", survey, "--out", out, "--blocks", "2", *FLAGS, "--schedule.checkpoint-every", "3000") == 0
    killer.join()
    return out


@pytest.fixture(scope="module", autouse=True)
def hasty_submitit():
    """submitit waits for what a dead process may still write."""
    before, submitit.LocalJob._results_timeout_s = submitit.LocalJob._results_timeout_s, 1
    yield
    submitit.LocalJob._results_timeout_s = before


def test_a_killed_job_goes_on_and_both_blocks_are_finished(merged):
    plan = BlockPlan.read(merged)
    logs = list((merged / "blocks" / "logs").glob("*/*_log.err"))
    assert len(plan.blocks) == 2 and len(logs) == 3, "one of them twice"
    for index in (0, 1):
        assert RunFolder(folder_of(merged, plan, index)).read_summary()["finished"]


def test_jobs_exchange_values_in_a_new_folder(merged):
    """They are pickled, so nobody may have prepared the folder."""
    folders = [path.name for path in (merged / "blocks" / "logs").iterdir()]
    assert folders and all(re.fullmatch(r"\d{8}-\d{6}-[0-9a-f]{8}", name) for name in folders)


def test_the_merged_run_is_as_good_as_its_blocks(merged):
    blocks = load_run(merged).metrics()[-1]["psnr_ldr"]
    plan = BlockPlan.read(merged)
    each = [load_run(folder_of(merged, plan, index)) for index in (0, 1)]
    held_out = [sum(entry.split == "test" for entry in run.cameras) for run in each]
    own = np.average([run.metrics()[-1]["psnr_ldr"] for run in each], weights=held_out)
    # Before Gaussians that reach far into other blocks were left out, three seeds lost 0, 0 and 3.3 dB.
    assert blocks > own - 0.3
    borders = json.loads((merged / "summary.json").read_text())["borders"]
    # Borders are some 150 pixels here, so chance decides: with three seeds they were 1.5 to 3.2 dB below the rest, with
    # one thread 1.7 dB above it to 0.4 below. In two runs with 400 photos they were 2.8 dB above it and 0.3 below.
    assert borders["border"] > borders["elsewhere"] - 4 and borders["share"] > 0.01


def test_each_place_has_the_gaussians_of_one_block(merged):
    plan, run = BlockPlan.read(merged), load_run(merged)
    means = run.field.normalization.scene_points(run.field.gaussians.means.numpy())
    owner, start = plan.division.block_of(means), 0
    for index in range(2):
        block = load_run(folder_of(merged, plan, index))
        assert block.base_time == run.base_time and block.response.to_dict() == run.response.to_dict()
        own = block.field.normalization.scene_points(block.field.gaussians.means.numpy())
        inside = plan.division.block_of(own) == index
        mine = owner == index
        assert 0 < inside.sum() < len(own), "Gaussians beyond the border are dropped"
        # A few reach far into the other block and are left out; a few cross the border as it is refined.
        assert abs(int(inside.sum()) - int(mine.sum())) <= 0.02 * inside.sum()
        assert mine[start : start + int(mine.sum())].mean() > 0.98
        sizes, merged_sizes = (
            np.sort((each.gaussians.log_scales.numpy()[rows] + np.log(each.normalization.unit)).ravel())
            for each, rows in ((block.field, inside), (run.field, mine))
        )
        assert np.quantile(sizes, 0.5) == pytest.approx(np.quantile(merged_sizes, 0.5), abs=0.02)
        start += int(mine.sum())
    assert run.field.confidence is not None and len(run.field.confidence) == run.gaussian_count
    assert torch.equal(run.clipped_share() >= 0, torch.ones(run.gaussian_count, dtype=torch.bool))


def test_other_commands_take_the_merged_run(merged, tmp_path):
    assert call("render", merged, "--out", tmp_path / "views", "--device", "cpu") == 0
    assert len(list((tmp_path / "views").rglob("*.exr"))) == 4
    assert call("envmap", merged, "--out", tmp_path / "map.exr", "--size", "32", "--device", "cpu") == 0
    assert call("export", merged, "--out", tmp_path / "town.ply", "--device", "cpu") == 0
    assert read_gaussians(tmp_path / "town.ply").count > 0.9 * load_run(merged).gaussian_count
    assert call("eval", merged, "--device", "cpu", "--json", tmp_path / "eval.json") == 0
    assert "psnr" in (tmp_path / "eval.json").read_text()


def test_finished_blocks_are_not_run_again(merged, monkeypatch):
    monkeypatch.setattr(jobs, "local_executors", lambda *_: pytest.fail("a job was started"))
    before = (merged / "checkpoints").stat().st_mtime_ns
    assert call("train", "--resume", "--out", merged, "--device", "cpu") == 0
    assert (merged / "checkpoints").stat().st_mtime_ns == before, "nor merged again"


def test_a_block_is_a_run_of_its_own(merged, capfd):
    assert call("train", "--resume", "--out", merged / "blocks" / "block_02", "--device", "cpu") == 0
    assert "nothing is left to train" in capfd.readouterr().err


def test_what_does_not_fit_is_refused_in_one_line(merged, survey, tmp_path, capfd):
    def line(*words):
        return refused(capfd, "train", survey, *words, "--device", "cpu", "--response", "srgb")

    assert "exists and is not empty" in line("--out", merged, "--blocks", "2")
    assert "has 2 blocks, but 3 were asked for" in line("--out", merged, "--blocks", "3", "--resume", *FLAGS)
    assert "schedule.iterations = " in line("--out", merged, "--resume", "--iterations", "999", "--preset", "fast")
    assert "too few for 9 blocks" in line("--out", tmp_path / "run", "--blocks", "9")
    new = ["train", survey, "--out", tmp_path / "run", "--blocks", "2", "--device", "cpu"]
    assert "--blocks with fusion.enabled" in refused(capfd, *new, "--fusion.enabled", "true")
    assert "learned response" in refused(capfd, *new, "--response", "learned")
    assert not (tmp_path / "run").exists()
    capfd.readouterr()
    wrong = (["--blocks", "1"], ["--blocks", "many"], ["--blocks", "9" * 5000], ["--slurm", "partition=gpu"])
    for words in (*wrong, ["--blocks", "2", "--view"]):
        assert call("train", survey, "--out", tmp_path / "run", *words, "-q") == 2
    assert len(capfd.readouterr().err.splitlines()) == 5


@pytest.mark.parametrize("flag", [("--blocks", "auto"), ("--blocks=auto",)])
def test_one_training_that_does_for_auto_takes_all_gpus(survey, tmp_path, monkeypatch, flag):
    started = []
    monkeypatch.setattr("sehdr_warp.blocks.train.train_in_blocks", lambda *_, **__: None)
    monkeypatch.setattr(
        "sehdr_warp.training.launch.launch_ranks", lambda count, _, words: started.append((count, words))
    )
    words = ["train", str(survey), "--out", str(tmp_path / "run"), "--gpus", "2", "--device", "cpu"]
    command = [*words, *flag]
    assert call(*command) == 0
    assert started == [(2, words)]


def test_a_block_that_cannot_be_trained_does_not_end_the_others(tmp_path, survey, divide, jobs_here, capfd):
    """One block's photos are gone when it begins; the other is trained, and --resume goes on once they are back."""
    out = tmp_path / "run"
    plan = divide(survey, out, iterations=20)
    only = min(set(plan.blocks[0].views) - set(plan.blocks[1].views))
    photo = survey / "images" / f"{only}.png"
    photo.rename(survey / "hidden.png")
    try:
        assert "block_01" in refused(capfd, "train", "--resume", "--out", out, "--device", "cpu")
    finally:
        (survey / "hidden.png").rename(photo)
    assert RunFolder(folder_of(out, plan, 1)).read_summary()["finished"]
    assert call("train", "--resume", "--out", out, "--device", "cpu") == 0
    assert load_run(out).iterations == 20
