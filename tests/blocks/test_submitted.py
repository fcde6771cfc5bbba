"""Jobs that SLURM ends go on."""

import signal

from sehdr_warp.blocks.block_plan import BlockPlan
from sehdr_warp.blocks.job import folder_of
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder

from ..refusals import call
from .cluster import FLAGS


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
