"""States of SLURM's jobs where submitit knows none."""

import signal

import pytest

from sehdr_warp.runs.run import load_run

from ..refusals import call
from .cluster import FLAGS

slurm_states = pytest.importorskip("sehdr_warp.blocks.slurm_states")


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
