"""Jobs of blocks: their GPUs and threads, what SLURM refuses, and a file system that loses what they write."""

import os
import shutil
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.blocks import jobs
from sehdr_warp.blocks.job import folder_of
from sehdr_warp.errors import SehdrError
from sehdr_warp.runs.run_folder import RunFolder

from ..refusals import call, refused
from .cluster import FLAGS


def test_a_file_system_that_loses_a_trained_block_is_named(divided, monkeypatch):
    """The other block stays."""
    folder, plan = divided
    out = folder / "run"

    def submit(job, *arguments):
        result = job(*arguments)._replace(node="far")
        if arguments[1] == 1:
            (folder_of(out, plan, 1) / "confidence.safetensors").unlink()
        return SimpleNamespace(done=lambda: True, exception=lambda: None, result=lambda: result)

    monkeypatch.setattr(jobs, "local_executors", lambda *_: [SimpleNamespace(submit=submit)])
    monkeypatch.setattr(jobs, "ARRIVES", 0.0)
    lost = r"block_02: node far: trained it, and .*block_02 does not hold the trained run: the file system has lost it"
    with pytest.raises(SehdrError, match=rf"{lost}; .*; 1 of 2 blocks are finished; resume=True trains"):
        jobs.run_blocks(out, plan, device=torch.device("cpu"))
    assert jobs.is_finished(folder_of(out, plan, 0))
    shutil.rmtree(out / "blocks")


@pytest.mark.parametrize(("at_once", "threads"), [(1, 8), (2, 4)])
def test_blocks_at_once_share_the_processors(divided, jobs_here, monkeypatch, at_once, threads):
    folder, plan = divided
    out = folder / "run"
    monkeypatch.setenv("SEHDR_THREADS", "8")

    jobs.run_blocks(out, plan, device=torch.device("cpu"), gpus=at_once)
    devices = {RunFolder(folder_of(out, plan, index)).read_summary()["device"] for index in range(2)}
    assert devices == {f"cpu ({threads} threads)"}
    shutil.rmtree(out / "blocks")


@pytest.mark.parametrize(
    ("first", "count", "refusal"),
    [
        ("cuda", 4, None),
        ("cuda:1", 3, None),
        ("cuda", 5, "--gpus 5: there are 4 GPUs, and each block takes one; use --gpus 4"),
        ("cuda:1", 4, "--gpus 4: there are 3 GPUs from cuda:1 on, and each block takes one; use --gpus 3"),
        ("cpu", 10**6, "too many blocks at once for"),
    ],
)
def test_blocks_at_once_need_as_many_gpus_from_the_first_on(monkeypatch, first, count, refusal):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    with nullcontext() if refusal is None else pytest.raises(SehdrError, match=refusal):
        jobs.check_devices(torch.device(first), count)


def test_what_slurm_refuses_is_one_line(cluster, survey, tmp_path, capfd, monkeypatch):
    def line(slurm):
        return refused(capfd, "train", survey, "--out", tmp_path / "run", *FLAGS, "--overwrite", "--slurm", slurm)

    assert (
        "--slurm cannot be used (Unknown argument 'colour' for executor 'slurm' in parameter 'slurm_colour')"
        in line("colour=red")
    )
    assert (
        call("train", survey, "--out", tmp_path / "run", *FLAGS, "--resume", "--slurm", "partition=closed", "-q") == 1
    )
    own, ours = capfd.readouterr().err.splitlines()
    assert own == "sbatch: error: invalid partition specified: closed" and ours.startswith("sehdr-warp: SLURM does not")
    assert own in ours and ours.endswith("check what --slurm asks for; --device cpu asks for no GPU")
    assert "time=4:00:00 is not a number of minutes; write time=240" in line("time=4:00:00")
    monkeypatch.setenv("PATH", "/nowhere")
    assert 'Could not detect "srun"' in line("partition=gpu")


@pytest.mark.parametrize(
    ("first", "count", "visible", "names"),
    [
        ("cuda", 1, None, ["0"]),
        ("cuda:1", 2, None, ["1", "2"]),
        ("cuda:0", 2, "3,5", ["3", "5"]),
        ("cuda:1", 1, "GPU-8f6c, GPU-71aa", ["GPU-71aa"]),
    ],
)
def test_blocks_take_the_gpus_that_the_user_made_visible(monkeypatch, first, count, visible, names):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert jobs.visible_gpus(torch.device(first), count) == names


def test_a_job_of_this_machine_sees_its_gpu_alone(monkeypatch, tmp_path):
    pytest.importorskip("submitit")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,GPU-71aa")
    executors = jobs.local_executors(tmp_path, 3, jobs.visible_gpus(torch.device("cuda"), 2))
    running = [executor.submit(os.getenv, "CUDA_VISIBLE_DEVICES") for executor in executors]
    assert [job.result() for job in running] == ["3", "GPU-71aa", "3"]


def test_slurm_jobs_take_the_parameters(tmp_path):
    submitit = pytest.importorskip("submitit")
    slurm = {"partition": "gpu", "time": "90", "mem": "64GB"}
    parameters = jobs.slurm_parameters(slurm, gpu=True)
    assert parameters == {"timeout_min": 90, "gpus_per_node": 1, "slurm_partition": "gpu", "slurm_mem": "64GB"}
    executor = submitit.AutoExecutor(folder=tmp_path, cluster="debug")  # Checks names and types as for SLURM.
    executor.update_parameters(name="town", **parameters)
    assert "gpus_per_node" not in jobs.slurm_parameters(slurm, gpu=False)
    of_srun = jobs.slurm_parameters({"cpus_per_task": "8"}, gpu=False)
    assert of_srun["slurm_cpus_per_task"] == 8 and of_srun["slurm_srun_args"] == ["--cpus-per-task=8"]
    executor.update_parameters(**of_srun)
