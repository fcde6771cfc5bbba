"""Trainings on two ranks: alike in every bit, about as good as one, and ended together whatever happens to one."""

import math
import os
import signal
import sys
import threading
import time
from multiprocessing import active_children
from types import SimpleNamespace

import pytest
import torch
from torch.multiprocessing import ProcessExitedException

from sehdr_warp.errors import SehdrError
from sehdr_warp.rasterizer import HarmonicsGradients
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.training.cost import gain_of_ranks
from sehdr_warp.training.flat_gradients import FlatGradients
from sehdr_warp.training.launch import device_of_rank
from sehdr_warp.training.optimizer import load_optimizer_tensors, make_optimizer, optimizer_tensors
from sehdr_warp.training.ranks import END, WAIT
from sehdr_warp.training.strategies import make_strategy
from sehdr_warp.training.train import train

from ..refusals import call
from . import team
from .toy import VARIANTS, make_trainer, toy_field, toy_scene

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


def test_rates_and_decays_follow_the_batch():
    config, field = VARIANTS["adc"], toy_field()
    one, four = (make_optimizer(field, config, batch) for batch in (1, 4))
    for a, b in zip(one.param_groups, four.param_groups, strict=True):
        assert b["lr"] == pytest.approx(2 * a["lr"])
    assert four.betas == pytest.approx([beta**4 for beta in one.betas])
    field.gaussians.means.grad = torch.ones_like(field.gaussians.means)
    four.step()
    saved = optimizer_tensors(four, 4)
    assert saved["means.0.step"] == 4
    load_optimizer_tensors(one, saved, 1)
    assert one.state[field.gaussians.means]["step"] == 4


def test_gradients_go_through_one_buffer():
    field = toy_field()
    optimizer = make_optimizer(field, VARIANTS["adc"])
    flat, gradients = FlatGradients(optimizer, 0, 1, defer_sh=False), {}
    for name in ("means", "opacity_logits"):
        parameter = getattr(field.gaussians, name)
        gradients[name] = parameter.grad = torch.randn_like(parameter)
    flat.collect(torch.tensor(2.0), torch.tensor(True))
    assert flat.fits(optimizer) and field.gaussians.means.grad is None
    flat.buffer.mul_(0.5)
    loss, overflow, harmonics = flat.distribute()
    assert harmonics is None and loss == 1 and bool(overflow) and field.gaussians.quaternions.grad is None
    for name, gradient in gradients.items():
        assert torch.equal(getattr(field.gaussians, name).grad, gradient / 2)
    field.gaussians.quaternions.grad = torch.ones_like(field.gaussians.quaternions)
    with pytest.raises(AssertionError, match="gradients of the same parameters"):
        flat.collect(torch.tensor(2.0), None)
    field.gaussians.resize(70, optimizer)
    assert not flat.fits(optimizer) and field.gaussians.count == 70


def test_harmonics_go_as_their_factors():
    field, count = toy_field(), 3
    optimizer, means = make_optimizer(field, VARIANTS["adc"]), field.gaussians.means
    ranks = [FlatGradients(optimizer, place, count, defer_sh=True) for place in range(count)]
    factors = [HarmonicsGradients(torch.randn(1, len(means), 3), torch.randn(1, 3), means, 1) for _ in ranks]
    for flat, harmonics in zip(ranks, factors, strict=True):
        means.grad = torch.ones_like(means)
        flat.collect(torch.tensor(2.0), None, harmonics)
    ranks[1].buffer.copy_(torch.stack([flat.buffer for flat in ranks]).mean(0))
    _, _, harmonics = ranks[1].distribute()
    assert harmonics.degree == 1 and ranks[1].buffer.numel() < 4 * count * means.numel() + 11 * len(means)
    assert torch.allclose(harmonics.grad_colors, torch.cat([one.grad_colors for one in factors]) / count)
    assert torch.allclose(harmonics.positions, torch.cat([one.positions for one in factors]))


@pytest.mark.parametrize("photos", [1, 2, 3, 8])
def test_each_change_happens_once_whatever_the_stride(photos):
    strategy = make_strategy(VARIANTS["default"], 1000)
    due = [n for n in range(photos, 91, photos) if strategy.is_due(n, photos)]
    assert [n // 25 for n in due] == [1, 2, 3] and (strategy.schedule.start, strategy.schedule.stop) == (20, 80)


def test_small_scenes_are_told_that_they_gain_nothing():
    gpu = torch.device("cuda", 0)
    assert "too few to gain" in gain_of_ranks(2, 2_000, 10_000, 4000, gpu)
    large = gain_of_ranks(2, 1_000_000, 2_000_000, 30_000, gpu)
    assert "estimated 1." in large and "too few" not in large
    assert "no faster than one" in gain_of_ranks(2, 1_000_000, 2_000_000, 30_000, torch.device("cpu"))
    assert math.isfinite(float(gain_of_ranks(8, 10**6, 10**6, 10**4, gpu).split("estimated ")[1].split()[0]))


def test_a_processor_takes_no_thousands_of_ranks():
    assert device_of_rank(1, "cpu").type == "cpu"
    with pytest.raises(SehdrError, match="100000 ranks on .* processors"):
        device_of_rank(99_999, "cpu")


def test_ranks_that_end_during_a_pause_are_not_asked_again():
    trainer, signals = make_trainer(toy_scene(), VARIANTS["default"]), []
    trainer.ranks = SimpleNamespace(all_reduce_min=lambda signal: signals.append(signal) or END)
    trainer.keep_ranks_waiting()
    assert trainer.ending and not trainer._agree_to_continue() and signals == [WAIT]
