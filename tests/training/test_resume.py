"""N steps equal N/2, kill -9, resume, N/2: bit for bit on the CPU."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from sehdr_warp.training.initialization import choose_response, make_field
from sehdr_warp.training.run import field_from_checkpoint
from sehdr_warp.training.run_folder import Checkpoint, RunFolder
from sehdr_warp.training.train import train
from sehdr_warp.training.trainer import Trainer

from .test_train import QUICK
from .toy import load_unscaled

TRAIN = """
import sys, time
sys.path.insert(0, sys.argv[1])
from tests.training.test_resume import configuration
from tests.training.toy import toy_scene
from sehdr_warp.training import trainer
from sehdr_warp.training.train import train

step = trainer.Trainer.step
def slow(self):
    # Past the checkpoint each step takes a while, so that the kill lands before the end.
    step(self)
    time.sleep(0.5 if self.iteration > 60 else 0)
trainer.Trainer.step = slow
train(toy_scene(), sys.argv[2], configuration(sys.argv[3]), device="cpu")
"""


def configuration(strategy):
    preset = strategy if strategy in ("paper", "hdr-gs") else "default"
    strategies = {"densification.strategy": strategy} if preset == "default" else {}
    if preset == "hdr-gs":
        strategies = {"response.name": "learned"}
    fixed = {"schedule.iterations": 120, "densification.every": 25}
    return load_unscaled(preset, QUICK | fixed | strategies)


def kill_after_checkpoint(out, strategy):
    root = Path(__file__).resolve().parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", TRAIN, str(root), str(out), strategy],
        env=os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
    )
    deadline = time.monotonic() + 120
    while not list((out / "checkpoints").glob("iteration_*")):
        assert process.poll() is None and time.monotonic() < deadline, "the training ended before its checkpoint"
        time.sleep(0.05)
    time.sleep(1.2)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


@pytest.mark.parametrize("strategy", ["gradient", "relocation", "paper"])
def test_resume_is_exact(scene, tmp_path, strategy):
    config = configuration(strategy)
    train(scene, tmp_path / "whole", config, device="cpu")
    kill_after_checkpoint(tmp_path / "killed", strategy)
    assert RunFolder(tmp_path / "killed").newest_checkpoint().values["iteration"] == 60
    # The statistics of a densification interval that the kill cut in two (50 to 75) are part of the state.
    run = train(scene, tmp_path / "killed", device="cpu", resume=True)
    whole = RunFolder(tmp_path / "whole").newest_checkpoint()
    resumed = RunFolder(tmp_path / "killed").newest_checkpoint()
    assert run.config == config and resumed.values["iteration"] == 120
    assert whole.tensors.keys() == resumed.tensors.keys()
    for name, value in whole.tensors.items():
        assert torch.equal(value, resumed.tensors[name]), name
    assert {k: whole.values[k] for k in ("order", "skipped_steps")} == {
        k: resumed.values[k] for k in ("order", "skipped_steps")
    }
    lines = [line["iteration"] for line in run.metrics()]
    assert lines == [10, 120], "each evaluation once"


def test_resume_before_the_first_checkpoint_starts_over(scene, tmp_path):
    config = configuration("gradient")
    whole = train(scene, tmp_path / "whole", config, device="cpu")
    train(scene, tmp_path / "cut", config, device="cpu")
    for folder in (tmp_path / "cut" / "checkpoints").iterdir():
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
    again = train(scene, tmp_path / "cut", device="cpu", resume=True)
    assert torch.equal(whole.model.gaussians.means, again.model.gaussians.means)
    assert len(again.metrics()) == len(whole.metrics())


def test_resume_of_a_finished_run_changes_nothing(scene, tmp_path):
    config = configuration("gradient")
    first = train(scene, tmp_path / "run", config, device="cpu")
    again = train(scene, tmp_path / "run", config, device="cpu", resume=True)
    assert torch.equal(first.model.gaussians.means, again.model.gaussians.means)
    assert first.metrics() == again.metrics()


@pytest.mark.parametrize("strategy", ["gradient", "hdr-gs"])
def test_a_trainer_continues_from_its_state(scene, strategy):
    config = configuration(strategy)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        whole = Trainer(scene, config, make_field(scene, config, choose_response(scene, config), "cpu"))
        _steps(whole, 45)
        tensors, values = whole.state()
        tensors = {name: value.clone() for name, value in tensors.items()}
        info = {"response": whole.field.response.to_dict(), "base_time": whole.field.base_time}
        field = field_from_checkpoint(Checkpoint(Path("memory"), tensors, values), config, info)
        resumed = Trainer(scene, config, field)
        resumed.load_state(tensors, values)
        for trainer in (whole, resumed):
            _steps(trainer, 35)
    finally:
        torch.set_num_threads(threads)
    again = resumed.state()[0]
    for name, value in whole.state()[0].items():
        assert torch.equal(value, again[name]), name


def _steps(trainer, count):
    for _ in range(count):
        trainer.step()
