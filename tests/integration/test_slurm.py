"""Trainings on a SLURM cluster that answers: the guide's batch script, and blocks as jobs. Skipped elsewhere."""

import os
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from benchmarks.survey import write_survey
from sehdr_warp.blocks.block_plan import BlockPlan
from sehdr_warp.blocks.job import folder_of
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder

from ..refusals import call, refused

GUIDE = Path(__file__).parents[2] / "docs" / "large.md"
FLAGS = ["--device", "cpu", "--response", "srgb", "--preset", "fast"]


def idle_nodes() -> int:
    """Nodes of the default partition that wait for jobs; 0 without a cluster."""
    if shutil.which("sinfo") is None:
        return 0
    try:
        answer = subprocess.run(["sinfo", "-h", "-t", "idle", "-o", "%D"], capture_output=True, text=True, timeout=10)
    except subprocess.TimeoutExpired:
        return 0
    return sum(int(line) for line in answer.stdout.split() if line.isdigit())


pytestmark = pytest.mark.skipif(idle_nodes() < 2, reason="needs a SLURM cluster with two idle nodes")
pytest.importorskip("submitit")


@pytest.fixture
def survey(tmp_path):
    write_survey(tmp_path / "photos", views=32, size=48, gaussians=6000)
    return tmp_path / "photos"


def batch_script(survey, out) -> str:
    """Return castle.sbatch of the guide for two nodes with a processor each."""
    lines = re.search(r"as `castle.sbatch`:\n\n((?:    .*\n)+)", GUIDE.read_text())
    assert lines is not None
    script = "".join(line[4:] for line in lines[1].splitlines(keepends=True))
    changes = {
        "--gpus-per-node=4 --cpus-per-task=32 --time=8:00:00": "--cpus-per-task=1 --time=0:10:00",
        "--nproc-per-node 4": "--nproc-per-node 1",
        " torchrun ": f" {sys.executable} -m torch.distributed.run ",
        "/shared/photos": str(survey),
        "/shared/runs/castle": str(out),
        "--resume &": f"--resume --iterations 200 {' '.join(FLAGS)} &",
    }
    for text, small in changes.items():
        assert script.count(text) == 1, text
        script = script.replace(text, small)
    return script


def test_the_guides_batch_script_trains_on_two_nodes_and_resumes(survey, tmp_path):
    out, script = tmp_path / "run", tmp_path / "castle.sbatch"
    script.write_text(batch_script(survey, out))
    for _ in range(2):  # The second time, nothing is left to train.
        command = ["sbatch", "--wait", f"--output={tmp_path / 'job.txt'}", str(script)]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=300)
        printed = (tmp_path / "job.txt").read_text()
        assert ended.returncode == 0, printed
        assert load_run(out).iterations == 200
    assert printed.count("training begins there") == 1


def kill_first_job(out) -> None:
    """Kill a block's job without notice when it has written a checkpoint of its training."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if list(out.glob("blocks/block_*/checkpoints/iteration_*[1-9]*")):
            jobs = subprocess.run(["squeue", "-h", "-n", "sehdr-warp", "-o", "%A"], capture_output=True, text=True)
            subprocess.run(["scancel", "--signal=KILL", jobs.stdout.split()[0]])
            return
        time.sleep(0.2)


def test_a_killed_job_goes_on_and_finished_blocks_are_not_run_again(survey, tmp_path):
    out = tmp_path / "run"
    killer = threading.Thread(target=kill_first_job, args=(out,))
    killer.start()
    words = ["--iterations", "600", "--schedule.checkpoint-every", "3000", "--slurm", "time=10,cpus_per_task=1"]
    assert call("train", survey, "--out", out, *[*FLAGS, "--blocks", "2", *words]) == 0
    killer.join()
    results = list(out.glob("blocks/logs/*/*_submitted.pkl"))
    assert len(results) == 3, "two blocks, and one of them again"
    plan = BlockPlan.read(out)
    folders = [folder_of(out, plan, index) for index in (0, 1)]
    assert all(RunFolder(folder).read_summary()["finished"] for folder in folders)
    times = [os.stat(folder / "summary.json").st_mtime_ns for folder in folders]
    assert call("train", "--resume", "--out", out, "--slurm", "time=10") == 0
    assert times == [os.stat(folder / "summary.json").st_mtime_ns for folder in folders]
    assert load_run(out).iterations == 600


def test_what_slurm_refuses_is_one_line(survey, tmp_path, capfd):
    words = ["train", survey, "--out", tmp_path / "run", *FLAGS, "--blocks", "2", "--overwrite", "--slurm"]
    assert "time=4:00:00 is not a number of minutes; write time=240" in refused(capfd, *words, "time=4:00:00")
    assert call(*words, "partition=no_such_partition,time=1", "-q") == 1
    assert "check what --slurm asks for" in capfd.readouterr().err.splitlines()[-1]
