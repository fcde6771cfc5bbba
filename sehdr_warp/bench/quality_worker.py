"""A worker of `bench quality`: takes job after job from the plan until none is left. Started by quality_pool.py.

Whoever holds the lock of a job's folder is at the job; the operating system lets go of it when a worker dies, however
it dies. attempt.json, written under the lock, then tells that the job took its worker along.
"""

import json
import os
import sys
import traceback
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import SehdrError
from ..files import write_json
from .quality_jobs import (
    ATTEMPT,
    FAILURE,
    LOCK,
    RESULT,
    read_attempt,
    read_failure,
    read_job,
    read_result,
    write_failure,
)

PLAN, RUN_LOCK = "plan.json", "run.lock"


def work(out: str, worker: str, gpu: str | None = None, environment: dict[str, str] | None = None) -> int:
    """Runs jobs of out/plan.json; returns how many. gpu: what CUDA_VISIBLE_DEVICES is set to, None to leave it.

    Ends when no job is free, or when the run that started it has gone; on a GPU also after a job that failed, which may
    have spoilt the device for this process: quality_pool.py starts another worker.
    """
    # Before torch is imported: it reads these once.
    os.environ.update(environment or {})
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu
    folder = Path(out)
    plan = json.loads((folder / PLAN).read_text(encoding="utf-8"))
    runner, count, before = None, 0, -1
    while count > before:  # what another process held for a moment is free at the next pass
        before = count
        for name in plan["jobs"]:
            if abandoned(folder):
                return count
            job_folder = folder / "jobs" / name
            if not is_open(job_folder, plan["run"]):
                continue
            with JobLock(job_folder) as held:
                if held and is_open(job_folder, plan["run"]):
                    runner = runner or _runner(plan)
                    done = _attempt(runner, job_folder, plan["run"], worker)
                    count += 1
                    if not done and plan["device"] == "cuda":
                        return count
    return count


def is_open(folder: Path, run: str) -> bool:
    """Whether a job is still to be done: no complete result, and no attempt in this run."""
    if read_result(folder) is not None:
        return False
    return not any(entry and entry.get("run") == run for entry in (read_attempt(folder), read_failure(folder)))


class JobLock:
    """`with JobLock(folder) as held`: the lock of a job's folder, or False if another process has it."""

    def __init__(self, folder: Path):
        self.lock = FileLock(folder / LOCK)

    def __enter__(self) -> bool:
        try:
            self.lock.acquire(timeout=0)
        except Timeout:
            return False
        return True

    def __exit__(self, *_) -> None:
        self.lock.release()


def abandoned(out: Path) -> bool:
    """Whether nobody holds the lock of the whole run any more: it was killed, and its workers follow."""
    lock = FileLock(out / RUN_LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return False
    lock.release()
    return True


def _runner(plan: dict):
    from .quality_run import Runner

    return Runner(
        "cuda:0" if plan["device"] == "cuda" else plan["device"],
        lpips=plan["lpips"],
        shared_by=plan["shared_by"],
        keep_runs=plan["keep_runs"],
    )


def _attempt(runner, folder: Path, run: str, worker: str) -> bool:
    """Whether the job has a result now; what went wrong is in its folder."""
    write_json(folder / ATTEMPT, {"run": run, "worker": worker, "pid": os.getpid()}, overwrite=True)
    try:
        result = runner.run(read_job(folder), folder)
        write_json(folder / RESULT, result, overwrite=True)
        (folder / FAILURE).unlink(missing_ok=True)
        return True
    except SehdrError as error:
        write_failure(folder, run, str(error))
    except Exception as error:  # noqa: BLE001 - a defect, or a device out of memory, costs one job, not the run
        traceback.print_exc()
        write_failure(folder, run, f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
    finally:
        # Not reached by a worker that is killed: then the attempt stays, and tells.
        (folder / ATTEMPT).unlink(missing_ok=True)
    return False


if __name__ == "__main__":
    arguments = json.loads(sys.argv[1])
    work(**arguments)
