"""N steps equal N/2, an end without warning, resume, N/2: bit for bit on the CPU."""

import shutil
import signal
import subprocess
import sys
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


def configuration(strategy):
    preset = strategy if strategy in ("paper", "hdr-gs") else "default"
    strategies = {"densification.strategy": strategy} if preset == "default" else {}
    if preset == "hdr-gs":
        strategies = {"response.name": "learned"}
    fixed = {"schedule.iterations": 120, "densification.every": 25}
    return load_unscaled(preset, QUICK | fixed | strategies)


@pytest.mark.parametrize("strategy", ["gradient", "relocation", "paper"])
def test_resume_is_exact(scene, tmp_path, strategy):
    config = configuration(strategy)
    for step in Training(scene, tmp_path / "whole", config, device="cpu"):
        if step.iteration == 66:  # As a kill would leave it.
            shutil.copytree(tmp_path / "whole", tmp_path / "killed")
    assert RunFolder(tmp_path / "killed").newest_checkpoint().values["iteration"] == 60
    # The statistics of a densification interval that the kill cut in two (50 to 75) are part of the state.
    run = train(scene, tmp_path / "killed", device="cpu", resume=True)
    whole = RunFolder(tmp_path / "whole").newest_checkpoint()
    resumed = RunFolder(tmp_path / "killed").newest_checkpoint()
    assert run.config == config and resumed.values["iteration"] == 120
    assert whole.tensors.keys() == resumed.tensors.keys()
    for name, value in whole.tensors.items():
        assert torch.equal(value, resumed.tensors[name]), name
    for name in ("order", "skipped_steps"):
        assert whole.values[name] == resumed.values[name]
    assert [line["iteration"] for line in run.metrics()] == [10, 120], "each evaluation once"
    # Of a finished run nothing changes.
    again = train(scene, tmp_path / "killed", config, device="cpu", resume=True)
    assert torch.equal(run.model.gaussians.means, again.model.gaussians.means) and run.metrics() == again.metrics()


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


@pytest.fixture(scope="module")
def old(scene, tmp_path_factory):
    config = configuration("gradient").model_copy(update={"seed": 4})
    return train(scene, tmp_path_factory.mktemp("old") / "run", config, device="cpu")


@pytest.mark.parametrize("moment", [3, 33, 40, 46])
def test_a_run_is_replaced_whole_or_not_at_all(scene, old, tmp_path, moment):
    """Killed at any change of the disk, the old run or the new one is there, and what is another's stays."""
    out = tmp_path / "run"
    shutil.copytree(old.path, out)
    for name in ("notes.txt", "checkpoints/iteration_best"):
        (out / name).write_text("mine")
    root = Path(__file__).resolve().parents[2]
    call = [sys.executable, "-c", KILL, str(root), str(out), str(moment)]
    ended = subprocess.run(call, check=False, capture_output=True, text=True)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    run = load_run(out)
    assert (run.config.seed, run.iterations) in ((4, 120), (5, 0))
    assert run.config.seed == 5 or torch.equal(run.model.gaussians.means, old.model.gaussians.means)
    again = train(scene, out, device="cpu", resume=True)
    assert again.iterations == 120
    assert (out / "notes.txt").read_text() == (out / "checkpoints" / "iteration_best").read_text() == "mine"
    hidden = [path.name for path in out.rglob(".*") if path.name != ".lock"]
    assert hidden == []


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
