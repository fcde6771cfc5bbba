"""Blocks as SLURM jobs: sbatch, srun, sacct and scontrol of a cluster of one node are scripts, submitit is itself."""

import os
import signal
import sys

import pytest

from sehdr_warp.blocks.block_plan import BlockPlan
from sehdr_warp.blocks.job import folder_of
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder

from ..refusals import call, refused

submitit = pytest.importorskip("submitit")
slurm_states = pytest.importorskip("sehdr_warp.blocks.slurm_states")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="SLURM runs on Linux")

# Jobs are scripts in $CLUSTER, named by their number; their states are in files beside them.
SBATCH = """#!/bin/bash
grep -q -- '--partition=closed' "$1" && { echo 'sbatch: error: invalid partition specified: closed' >&2; exit 1; }
number=$((100 + $(ls "$CLUSTER" | grep -c '\\.sh$')))
cp "$1" "$CLUSTER/$number.sh"
start_job $number > /dev/null 2>&1 &
echo "Submitted batch job $number"
"""
START = """#!/bin/bash
export SLURM_JOB_ID=$1 SLURM_NTASKS=1 SLURM_JOB_NUM_NODES=1 SLURM_NODEID=0 SLURM_PROCID=0 SLURM_LOCALID=0
export SLURM_JOB_NODELIST=node7
echo RUNNING > "$CLUSTER/$1.state"
bash "$CLUSTER/$1.sh" && echo COMPLETED > "$CLUSTER/$1.state" || echo FAILED > "$CLUSTER/$1.state"
[ -e "$CLUSTER/$1.requeue" ] && mv "$CLUSTER/$1.requeue" "$CLUSTER/$1.requeued" && exec start_job $1
"""
SRUN = """#!/bin/bash
while [[ $1 == --* ]]; do
    case $1 in
        --output) output=$2; shift 2;;
        --error) error=$2; shift 2;;
        *) shift;;
    esac
done
fill() { sed "s/%j/$SLURM_JOB_ID/; s/%t/0/" <<< "$1"; }
exec "$@" >> "$(fill "$output")" 2>> "$(fill "$error")"
"""
SACCT = """#!/bin/bash
echo 'JobID|State|NodeList'
for state in "$CLUSTER"/*.state; do echo "$(basename "$state" .state)|$(cat "$state")|node7"; done
"""
SQUEUE = """#!/bin/bash
case "$*" in
    *PENDING*) echo '100|PartitionTimeLimit'; echo '7|Priority';;
    *) for state in "$CLUSTER"/*.state; do echo "$(basename "$state" .state)|$(cat "$state")"; done;;
esac
"""
SCONTROL = """#!/bin/bash
[ "$1" = requeue ] && touch "$CLUSTER/$2.requeue"
"""

FLAGS = ["--device", "cpu", "--response", "srgb", "--iterations", "200", "--preset", "fast", "--blocks", "2"]


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Scripts in place of SLURM's programs; the folder of its jobs."""
    programs, jobs = tmp_path / "bin", tmp_path / "jobs"
    jobs.mkdir()
    scripts = {
        "sbatch": SBATCH,
        "start_job": START,
        "srun": SRUN,
        "sacct": SACCT,
        "squeue": SQUEUE,
        "scontrol": SCONTROL,
    }
    programs.mkdir()
    for name, text in scripts.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("CLUSTER", str(jobs))
    # submitit asks for states every ten minutes, and waits for what a dead process may still write.
    monkeypatch.setattr(submitit.SlurmJob.watcher, "_delay_s", 1)
    monkeypatch.setattr(submitit.SlurmJob, "_results_timeout_s", 1)
    return jobs


def test_jobs_that_are_ended_go_on_and_the_blocks_are_merged(cluster, survey, interrupt, tmp_path):
    """SIGUSR2 announces the time limit, SIGTERM that another job takes the node."""
    out = tmp_path / "run"
    ended = {"block_01": signal.SIGUSR2, "block_02": signal.SIGTERM}
    threads = [interrupt(out / "blocks" / name, number) for name, number in ended.items()]
    words = ["--schedule.checkpoint-every", "3000", "--slurm", "partition=gpu,time=9,mem=4GB"]
    assert call("train", survey, "--out", out, *[*FLAGS, *words]) == 0
    for thread in threads:
        thread.join()
    scripts = [script.read_text() for script in sorted(cluster.glob("*.sh"))]
    assert len(scripts) == 3 and len(list(cluster.glob("*.requeued"))) == 1, "SLURM requeues one, the other is new"
    for flag in ("--partition=gpu", "--time=9", "--mem=4GB", "--job-name=sehdr-warp"):
        assert all(f"#SBATCH {flag}\n" in script for script in scripts)
    plan = BlockPlan.read(out)
    assert all(RunFolder(folder_of(out, plan, index)).read_summary()["finished"] for index in (0, 1))
    assert load_run(out).iterations == 200


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


def test_a_killed_job_is_noticed_without_accounts(cluster, survey, interrupt, tmp_path, monkeypatch, capfd):
    sacct = tmp_path / "bin" / "sacct"
    sacct.write_text("#!/bin/bash\necho 'Slurm accounting storage is disabled' >&2\nexit 1\n")
    monkeypatch.setattr(slurm_states, "LOOK_EVERY", 1.0)
    out = tmp_path / "run"
    thread = interrupt(out / "blocks" / "block_01", signal.SIGKILL)
    words = ["--schedule.checkpoint-every", "3000", "--slurm", "partition=gpu,time=9"]
    assert call("train", survey, "--out", out, *[*FLAGS, *words]) == 0
    thread.join()
    printed = capfd.readouterr().err
    assert len(list(cluster.glob("*.sh"))) == 3
    assert "ended without a result (job 10" in printed and "state FAILED" in printed
    assert printed.count("SLURM: jobs wait (PartitionTimeLimit); they never start with so much time") == 1
    assert "Priority" not in printed, "of another job"
    assert load_run(out).iterations == 200


def test_states_that_submitit_does_not_know_are_no_end():
    watcher = slurm_states.QueueWatcher()
    for number in "1234":
        watcher.register_job(number)
    states = watcher.read_info(b"1|CONFIGURING\n2|TIMEOUT\n3|SUSPENDED\n9|RUNNING\n")
    assert {number: row["State"] for number, row in states.items()} == {
        "1": "RUNNING",
        "2": "TIMEOUT",
        "3": "RUNNING",
        "4": "ENDED",
    }
