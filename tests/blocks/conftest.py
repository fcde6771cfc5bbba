"""A town as survey photos, and as two trained blocks, for all tests of blocks."""

import os
import shutil
import sys
import threading
import time
from contextlib import suppress
from functools import cache
from glob import glob
from types import SimpleNamespace

import pytest
import torch

from benchmarks.survey import write_survey
from sehdr_warp.blocks import jobs
from sehdr_warp.blocks.block_plan import make_block_plan
from sehdr_warp.blocks.job import train_block
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import override_config
from sehdr_warp.training.launch import installed_versions

from .cluster import SCRIPTS

LITTLE = {"model.initial_density": 0.0, "mcmc.seed_fraction": 0.0, "loss.light_prior": False}


@pytest.fixture(scope="session")
def survey(tmp_path_factory):
    """The folder of 32 photos of a town; not to be changed."""
    folder = tmp_path_factory.mktemp("survey") / "town"
    write_survey(folder, views=32, size=48, gaussians=6000)
    return folder


@pytest.fixture(scope="session")
def divide():
    """Return a function that divides photos for a training of few steps into two blocks, and writes their plan."""

    def divide(photos, out, iterations):
        data = {"path": str(photos), "exposure_index": None, "max_size": None, "holdout": None}
        fields = {"response.name": "srgb", "schedule.iterations": iterations}
        plan = make_block_plan(data, override_config(Config(), fields | LITTLE), torch.device("cpu"), 2)
        assert plan is not None
        out.mkdir()
        plan.write(out)
        return plan

    return divide


@pytest.fixture(scope="session")
def two_blocks(survey, divide, tmp_path_factory):
    """Return a function that trains two blocks and returns their folder and plan; what changes them restores them."""

    @cache
    def train(iterations):
        out = tmp_path_factory.mktemp("trained") / "run"
        plan = divide(survey, out, iterations)
        for index in (0, 1):
            assert train_block(out, index, "cpu", installed_versions()).error is None
        return out, plan

    return train


@pytest.fixture(scope="session")
def interrupt():
    """Return a function that sends a signal, in a thread, to the process that trains a block."""

    def locker(folder):
        """Return the process that holds the lock of the folder, or None."""
        for handle in glob("/proc/[0-9]*/fd/*") if (folder / ".lock").exists() else ():
            with suppress(OSError):
                if os.readlink(handle) == str(folder / ".lock"):
                    return int(handle.split("/")[2])
        return None

    def send(folder, number):
        """Find the process before its training has written a checkpoint, since the end may come soon after that."""
        process, deadline = None, time.monotonic() + 300
        while time.monotonic() < deadline:
            process = process or locker(folder)
            if process and glob(f"{folder}/checkpoints/iteration_*[1-9]*"):
                os.kill(process, number)
                return
            time.sleep(0.02)

    def begin(folder, number):
        thread = threading.Thread(target=send, args=(folder, number))
        thread.start()
        return thread

    return begin


@pytest.fixture
def jobs_here(monkeypatch):
    """Jobs of this machine run one after the other in this process, whose libraries are loaded."""

    def submit(job, *arguments):
        result = job(*arguments)
        return SimpleNamespace(done=lambda: True, exception=lambda: None, result=lambda: result)

    monkeypatch.setattr(jobs, "local_executors", lambda _, slots, __: [SimpleNamespace(submit=submit)] * slots)


@pytest.fixture(scope="module")
def divided(survey, divide, tmp_path_factory):
    """A folder with photos in `town` and a plan of two blocks in `run`, and the plan."""
    folder = tmp_path_factory.mktemp("divided")
    shutil.copytree(survey, folder / "town")
    return folder, divide(folder / "town", folder / "run", iterations=20)


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Scripts in place of SLURM's programs; the folder of its jobs."""
    submitit = pytest.importorskip("submitit")
    if sys.platform != "linux":
        pytest.skip("SLURM runs on Linux")
    programs, jobs = tmp_path / "bin", tmp_path / "jobs"
    jobs.mkdir()
    programs.mkdir()
    for name, text in SCRIPTS.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("CLUSTER", str(jobs))
    # submitit asks for states every ten minutes, and waits for what a dead process may still write.
    monkeypatch.setattr(submitit.SlurmJob.watcher, "_delay_s", 1)
    monkeypatch.setattr(submitit.SlurmJob, "_results_timeout_s", 1)
    return jobs
