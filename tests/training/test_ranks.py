"""Trainings on two ranks: alike in every bit, about as good as one, and ended together whatever happens to one."""

import os
import signal
import sys
import threading
import time
from multiprocessing import active_children

import pytest
import torch
from torch.multiprocessing import ProcessExitedException

from sehdr_warp.errors import SehdrError
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.training.ranks import rank_timeout
from sehdr_warp.training.train import train

from ..refusals import call
from . import team

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="ranks share photos through Linux's /proc")


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    folder = tmp_path_factory.mktemp("together")
    with pytest.raises(ProcessExitedException, match="process 0 terminated with exit code 1"):
        team.run_team(_all, folder)
    return folder


def _all(ranks, folder):
    team.train_together(ranks, folder, ["adc", "default"], 60)
    team.differ(ranks, folder)
    team.mixed(ranks, folder)
    team.fall_silent(ranks, folder)


@pytest.mark.parametrize("strategy", ["adc", "default"])
def test_ranks_stay_alike_and_one_can_go_on(scene, trained, together, strategy):
    """Counts change at 25 and 50, in steps of two photos; at 60 they stop, and one rank goes on to 90."""
    (tensors, values), (others, their_values) = (
        torch.load(together / f"{strategy}.{rank}", weights_only=False) for rank in (0, 1)
    )
    values["seconds"] = their_values["seconds"]
    assert values == their_values and values["iteration"] == 60
    for name, value in tensors.items():
        # Statistics stand on rank 0 alone, whose draws decide for all.
        assert name.startswith(("densification.", "generators.device")) or torch.equal(value, others[name]), name
    assert tensors["optimizer.means.0.step"] == 60, "counted in photos"
    alone = load_run(trained(strategy))
    run = train(scene, together / strategy, device="cpu", resume=True)
    assert run.iterations == alone.iterations == 90
    ours, theirs = (each.metrics()[-1]["psnr_ldr"] for each in (run, alone))
    assert ours == pytest.approx(theirs, abs=1.0)
    assert run.gaussian_count == pytest.approx(alone.gaussian_count, rel=0.2)


def test_ranks_that_differ_say_where(together):
    for rank in (0, 1):
        assert (together / f"differ.{rank}").read_text().startswith("iteration 5: means differs between ranks")


def test_other_versions_are_refused(together):
    for rank in (0, 1):
        line = (together / f"mixed.{rank}").read_text()
        assert line.startswith("rank 1 runs sehdr-warp 1.1") and "rank 0 sehdr-warp 1.0" in line


def test_a_rank_that_does_not_answer_ends_the_others(together):
    assert (together / "silent").read_text().startswith("another rank did not answer rank 0 of 2 for 2 s")


@pytest.fixture
def command(tmp_path, monkeypatch, capfd):
    """Trains on two ranks and does what is given to them once there is a checkpoint; exit status and lines."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    monkeypatch.setenv("SEHDR_RANK_TIMEOUT", "60")

    def train(disturb, *words):
        flags = "--device cpu --gpus 2 --max-size 24 --preset fast --response srgb --iterations 20000"
        flags += " --schedule.checkpoint-every 30 --model.initial-density 0 --mcmc.seed-fraction 0"
        watcher = threading.Thread(target=once_saved, args=(tmp_path / "run", disturb))
        watcher.start()
        status = call("train", "embedded", "--out", tmp_path / "run", *[*flags.split(), *words])
        watcher.join()
        return status, capfd.readouterr().err

    yield train
    for number, handler in handlers.items():
        signal.signal(number, handler)


def once_saved(out, disturb):
    """Calls disturb(ranks) when a run has been saved; ends the ranks if that never happens."""
    deadline = time.monotonic() + 120
    while not any((out / "checkpoints").glob("iteration_*[1-9]*")):
        if time.monotonic() > deadline:
            return [rank.kill() for rank in active_children()]
        time.sleep(0.1)
    return disturb(sorted(active_children(), key=lambda rank: rank.pid))


def test_the_end_of_one_rank_ends_all_with_a_line(command, tmp_path):
    status, lines = command(lambda ranks: ranks[1].kill(), "-q")
    assert status == 1 and len(lines.splitlines()) == 1 and "rank 1 of 2 was killed (SIGKILL)" in lines
    assert RunFolder(tmp_path / "run").newest_checkpoint().values["iteration"] > 0


def test_a_signal_saves_and_ends_all(command, tmp_path):
    status, lines = command(lambda _: os.kill(os.getpid(), signal.SIGTERM))
    assert status == 143 and "stopped at iteration" in lines, lines
    assert load_run(tmp_path / "run").iterations > 0


@pytest.mark.parametrize("seconds", ["nan", "-1", "x", "inf"])
def test_times_that_cannot_be_are_refused(monkeypatch, seconds):
    monkeypatch.setenv("SEHDR_RANK_TIMEOUT", seconds)
    with pytest.raises(SehdrError, match=f"SEHDR_RANK_TIMEOUT = {seconds} is not a number of seconds"):
        rank_timeout()
