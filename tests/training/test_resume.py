"""N steps equal N/2, kill -9, resume, N/2: bit for bit on the CPU."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.training.checkpoint import Checkpoint
from sehdr_warp.training.initialization import choose_response, make_field
from sehdr_warp.training.run import field_from_checkpoint, load_run
from sehdr_warp.training.run_folder import RunFolder
from sehdr_warp.training.train import Training, train
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
    while not (out / "checkpoints" / "iteration_00000060").exists():
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


def test_a_run_begins_with_a_checkpoint_of_its_start(scene, tmp_path):
    config = configuration("gradient")
    whole = train(scene, tmp_path / "whole", config, device="cpu")
    begun = Training(scene, tmp_path / "cut", config, device="cpu")
    assert RunFolder(tmp_path / "cut").newest_checkpoint().values["iteration"] == 0
    with pytest.raises(InputError, match="another training is at work"):
        train(scene, tmp_path / "cut", device="cpu", resume=True)
    del begun
    again = train(scene, tmp_path / "cut", device="cpu", resume=True)
    assert torch.equal(whole.model.gaussians.means, again.model.gaussians.means)
    assert len(again.metrics()) == len(whole.metrics())


KILL = """
import os, signal, sys
sys.path.insert(0, sys.argv[1])
from tests.training.test_resume import configuration
from tests.training.toy import toy_scene
from sehdr_warp.training.train import train
left = int(sys.argv[3])
def dying(function):
    def call(*arguments, **options):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)
    return call
for name in ("rename", "replace", "unlink", "rmdir", "mkdir", "fsync"):
    setattr(os, name, dying(getattr(os, name)))
config = configuration("gradient").model_copy(update={"seed": 5})
train(toy_scene(), sys.argv[2], config, device="cpu", overwrite=True)
"""


@pytest.mark.parametrize("moment", [3, 33, 40, 46])
def test_a_run_is_replaced_whole_or_not_at_all(scene, tmp_path, moment):
    """Killed at any change of the disk, the old run or the new one is there, and what is another's stays."""
    out = tmp_path / "run"
    old = train(scene, out, configuration("gradient").model_copy(update={"seed": 4}), device="cpu").model
    for name in ("notes.txt", "checkpoints/iteration_best"):
        (out / name).write_text("mine")
    root = Path(__file__).resolve().parents[2]
    call = [sys.executable, "-c", KILL, str(root), str(out), str(moment)]
    ended = subprocess.run(call, check=False, capture_output=True, text=True)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    run = load_run(out)
    assert (run.config.seed, run.iterations) in ((4, 120), (5, 0))
    assert run.config.seed == 5 or torch.equal(run.model.gaussians.means, old.gaussians.means)
    again = train(scene, out, device="cpu", resume=True)
    assert again.iterations == 120
    assert (out / "notes.txt").read_text() == (out / "checkpoints" / "iteration_best").read_text() == "mine"
    hidden = [path.name for path in out.rglob(".*") if path.name != ".lock"]
    assert hidden == []


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
