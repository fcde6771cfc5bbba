"""States of SLURM jobs, and why they wait.

submitit asks `sacct` for states. A cluster without accounts has none, and a job that was killed before it wrote its
result would be waited for without an end; so its queue is asked there.
"""

import logging
import subprocess
import time
from collections.abc import Collection
from contextlib import suppress

from submitit.slurm.slurm import SlurmInfoWatcher

log = logging.getLogger(__name__)

LONGEST = 600  # Seconds between two questions about a job that runs for long
ENDED = "BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "TIMEOUT"
LOOK_EVERY = 20.0  # Seconds between questions why jobs wait
TIME_REASONS = "TimeLimit", "MaxWall"  # Parts of reasons for which a job never starts
_ASKS = 30.0  # Seconds that a program of SLURM may take to answer


class QueueWatcher(SlurmInfoWatcher):
    """States of jobs by `squeue`, which has ended jobs for some minutes; a job that it does not know has ended."""

    def _make_command(self) -> list[str] | None:
        """Return the command that lists the jobs of this user; None if no job is watched."""
        if not self._registered - self._finished:
            return None
        return ["squeue", "--me", "--noheader", "--states=all", "--format=%A|%T"]

    def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
        """Return the information on all watched jobs from lines of number and state."""
        text = string if isinstance(string, str) else string.decode(errors="replace")
        rows = [line.strip().split("|") for line in text.splitlines()]
        # submitit takes states that it does not know, such as CONFIGURING, for an end.
        states = {row[0]: row[1] if row[1] in ENDED else "RUNNING" for row in rows if len(row) == 2}
        return {job: {"JobID": job, "State": states.get(job, "ENDED")} for job in self._registered - self._finished}


def job_watcher() -> SlurmInfoWatcher:
    """Return a watcher of the states of jobs on this cluster."""
    with suppress(OSError, subprocess.SubprocessError):
        query = subprocess.run(["sacct", "--noheader", "--starttime=now"], capture_output=True, timeout=_ASKS)
        if query.returncode == 0:
            return SlurmInfoWatcher(delay_s=LONGEST)
    log.info("SLURM accounting is off here: states of jobs are read from squeue")
    return QueueWatcher(delay_s=LONGEST // 10)


class WaitingNotes:
    """Report each reason for which jobs wait in SLURM's queue, once."""

    def __init__(self) -> None:
        """Start with the first question in LOOK_EVERY seconds."""
        self._reported: set[str] = set()
        self._next = time.monotonic() + LOOK_EVERY

    def look(self, jobs: Collection[str]) -> None:
        """Log why jobs, SLURM's numbers, wait, if the last look was LOOK_EVERY seconds ago."""
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + LOOK_EVERY
        command = ["squeue", "--me", "--noheader", "--states=PENDING", "--format=%A|%r"]
        with suppress(OSError, subprocess.SubprocessError):
            answer = subprocess.run(command, capture_output=True, text=True, timeout=_ASKS).stdout
            rows = [line.strip().partition("|") for line in answer.splitlines()]
            for reason in sorted({reason for job, _, reason in rows if job in jobs} - self._reported - {"None"}):
                self._reported.add(reason)
                never = any(part in reason for part in TIME_REASONS)
                remedy = "; they never start with so much time: end this command, --slurm time=MINUTES asks for less"
                log.log(
                    logging.WARNING if never else logging.INFO,
                    "SLURM: jobs wait (%s)%s",
                    reason,
                    remedy if never else "",
                )
