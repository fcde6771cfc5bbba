"""Worker processes for the jobs of `bench quality`: started, watched, replaced when they die.

submitit starts them (SLURM where there is one, else local processes); without submitit they are plain processes.
"""

import importlib.util
import json
import os
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import InputError, SehdrError
from ..files import write_json
from .quality_jobs import ATTEMPT, Job, read_attempt, read_failure, read_result, write_failure, write_job
from .quality_worker import PLAN, RUN_LOCK, JobLock, is_open, work

LAUNCHERS = ("auto", "slurm", "local", "process")
POLL_SECONDS = 0.5
LOCK_SECONDS = 2.0
"""How long a run waits for its folder: a worker that looks whether its run is alive holds the lock for a moment."""
LOCAL_MINUTES = 7 * 24 * 60
"""submitit ends its processes after a time; a worker lives as long as there are jobs."""
USELESS_WORKERS = 3
"""So many workers in a row that end without having touched a job stop the run: something is wrong with all of them."""


@dataclass(frozen=True)
class Workers:
    """How jobs are run.

    count: processes at one time. gpus: numbers of the GPUs they share in turn, empty on the CPU. lpips: folder of
    weights. keep_runs: keep trained models. slurm: parameters of submitit's SLURM executor, without their prefix;
    "time" is in minutes. launcher: out of LAUNCHERS; auto is submitit where it is installed, on SLURM if there is one.
    """

    count: int = 1
    gpus: tuple[int, ...] = ()
    lpips: str | None = None
    keep_runs: bool = False
    slurm: dict = field(default_factory=dict)
    launcher: str = "auto"

    @property
    def cluster(self) -> str | None:
        """Who starts workers: "slurm" or "local" of submitit, or None for plain processes."""
        if self.launcher == "process":
            return None
        if importlib.util.find_spec("submitit") is None:
            if self.launcher == "slurm":
                raise SehdrError("submitit is not installed; run `pip install sehdr-warp[bench]`")
            return None
        slurm = self.launcher == "slurm" or (self.launcher == "auto" and shutil.which("srun") is not None)
        return "slurm" if slurm else "local"

    @property
    def shared_by(self) -> int:
        """The most workers that one device has; SLURM gives each one of its own."""
        return 1 if self.cluster == "slurm" else -(-self.count // max(1, len(self.gpus)))


def run_jobs(jobs: Sequence[Job], out: Path, workers: Workers, device: str, progress: Callable[[str], None]) -> None:
    """Runs every job that has no result yet, and returns when each has a result or a failure in its folder.

    A job whose worker dies is a failure; the worker is replaced. Jobs that failed in an earlier run are tried again.
    Raises InputError if another run is at work in `out`, SehdrError if workers cannot be started; an interrupt stops
    the workers, and what is finished stays.
    """
    out.mkdir(parents=True, exist_ok=True)
    lock = FileLock(out / RUN_LOCK)
    try:
        lock.acquire(timeout=LOCK_SECONDS)
    except Timeout:
        raise InputError(
            out, "another `bench quality` is at work there", "wait for it, or choose another --out"
        ) from None
    try:
        folders = [write_job(out, job) for job in jobs]
        run = secrets.token_hex(6)
        todo = [folder for folder in folders if is_open(folder, run)]
        progress(f"{len(folders)} jobs, {len(folders) - len(todo)} finished before")
        if todo:
            plan = {
                "run": run,
                "jobs": [folder.name for folder in todo],
                "device": device,
                "lpips": workers.lpips,
                "shared_by": workers.shared_by,
                "keep_runs": workers.keep_runs,
            }
            write_json(out / PLAN, plan, overwrite=True)
            _Watch(out, run, todo, workers, progress).run()
    finally:
        lock.release()


class _Watch:
    def __init__(self, out: Path, run: str, todo: list[Path], workers: Workers, progress):
        self.out, self.id, self.workers, self.progress = out, run, workers, progress
        self.open, self.total = list(todo), len(todo)
        self.start = _launcher(out, workers, progress)
        self.live: dict[int, _Process] = {}
        self.started, self.useless, self.waiting = 0, 0, False

    def run(self) -> None:
        try:
            while True:
                # Dead workers first: what they leave behind decides which jobs are still open.
                ended = [place for place, process in self.live.items() if process.ended()]
                self._collect({place: self.live.pop(place) for place in ended})
                self._report()
                if not self.open and not self.live:
                    return
                self._staff()
                time.sleep(POLL_SECONDS)
        finally:
            for process in self.live.values():
                process.stop()

    def _collect(self, ended: dict) -> None:
        for process in ended.values():
            touched = False
            for folder in self.open:
                attempt = read_attempt(folder)
                if attempt and attempt.get("run") == self.id and attempt.get("worker") == process.name:
                    write_failure(folder, self.id, f"its worker died ({process.cause()}); see {process.log}")
                    (folder / ATTEMPT).unlink(missing_ok=True)
                    touched = True
            # A worker that found nothing to do ends well; one that could not start leaves an exit status.
            self.useless = self.useless + 1 if process.failed() and not touched else 0
            if self.useless >= USELESS_WORKERS:
                raise SehdrError(f"workers die before they take a job ({process.cause()}); see {process.log}")

    def _report(self) -> None:
        for folder in list(self.open):
            result, failure = read_result(folder), read_failure(folder)
            failed = failure is not None and failure.get("run") == self.id
            if result is None and not failed:
                continue
            self.open.remove(folder)
            done = f"{self.total - len(self.open)}/{self.total} {folder.name}"
            self.progress(f"{done}: {_figures(result) if result is not None else 'FAILED: ' + failure['error']}")

    def _staff(self) -> None:
        """As many workers as there are places and jobs that nobody has."""
        if len(self.live) >= min(self.workers.count, len(self.open)):
            return
        free = [folder for folder in self.open if is_open(folder, self.id) and _unlocked(folder)]
        if self.open and not free and not self.live and not self.waiting:
            self.progress(f"waiting for a worker of an earlier run that is still at {self.open[0].name}")
            self.waiting = True
        for place in range(self.workers.count):
            # Workers that have just started are about to take jobs: count them as if they had.
            idle = sum(not self._at_work(process) for process in self.live.values())
            if place not in self.live and len(free) > idle:
                self.live[place] = self.start(place, f"{self.id}-{self.started}")
                self.started += 1

    def _at_work(self, process) -> bool:
        attempts = (read_attempt(folder) for folder in self.open)
        return any(a and a.get("run") == self.id and a.get("worker") == process.name for a in attempts)


def _unlocked(folder: Path) -> bool:
    with JobLock(folder) as held:
        return held


def _figures(result: dict) -> str:
    figures = result["figures"]
    parts = [f"{name} {values['psnr_mu']:.2f} dB" for name, values in figures["protocol"].items() if values["psnr_mu"]]
    return f"{', '.join(parts)}, {figures['train_seconds']:.1f} s"


def _launcher(out: Path, workers: Workers, progress):
    """start(place, name) -> a worker that runs, by submitit or as a plain process."""
    cluster = workers.cluster
    if cluster is None:
        if workers.launcher != "process":
            progress("submitit is not installed: workers are plain local processes (pip install sehdr-warp[bench])")
        return lambda place, name: _Process(_arguments(out, workers, place, name), name, out)
    import submitit

    executor = submitit.AutoExecutor(folder=str(out / "workers" / "submitit"), cluster=cluster)
    return lambda place, name: _Submitted(executor, cluster, out, workers, place, name)


def _arguments(out: Path, workers: Workers, place: int, name: str) -> dict:
    gpu = None
    if workers.gpus:
        chosen = workers.gpus[place % len(workers.gpus)]
        # Where the GPUs to be seen were chosen from outside, ours are numbers among those.
        visible = [item for item in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if item]
        gpu = visible[chosen] if chosen < len(visible) else str(chosen)
    environment = {}
    if workers.count > 1 and "SEHDR_THREADS" not in os.environ:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        environment = {"SEHDR_THREADS": str(max(1, cores // workers.count)), "OMP_NUM_THREADS": "1"}
    return {"out": str(out.absolute()), "worker": name, "gpu": gpu, "environment": environment}


class _Process:
    """A worker as a plain process."""

    def __init__(self, arguments: dict, name: str, out: Path):
        self.name, self.log = name, out / "workers" / f"{name}.log"
        self.log.parent.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "sehdr_warp.bench.quality_worker", json.dumps(arguments)]
        with open(self.log, "w", encoding="utf-8") as log:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def ended(self) -> bool:
        return self.process.poll() is not None

    def failed(self) -> bool:
        return self.process.returncode != 0

    def cause(self) -> str:
        code = self.process.returncode
        return f"signal {-code}" if code < 0 else f"exit status {code}"

    def stop(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self.process.kill()


class _Submitted:
    """A worker that submitit started: a local process, or a SLURM job with one GPU of its own."""

    def __init__(self, executor, cluster: str, out: Path, workers: Workers, place: int, name: str):
        arguments = _arguments(out, workers, place, name)
        if cluster == "local":
            executor.update_parameters(name="sehdr-warp", timeout_min=LOCAL_MINUTES)
        else:
            arguments["gpu"] = None  # SLURM says which one it gives
            executor.update_parameters(name="sehdr-warp", **slurm_parameters(workers))
        self.name, self.job = name, executor.submit(work, **arguments)
        self.log = self.job.paths.stderr

    def ended(self) -> bool:
        return self.job.done()

    def failed(self) -> bool:
        return self.job.exception() is not None

    def cause(self) -> str:
        error = self.job.exception()
        return f"submitit job {self.job.job_id}: {str(error).splitlines()[0] if error else self.job.state}"

    def stop(self) -> None:
        self.job.cancel()


def slurm_parameters(workers: Workers) -> dict:
    """What submitit's AutoExecutor takes: one GPU a worker, and what the user said."""
    given = dict(workers.slurm)
    minutes = {"timeout_min": int(given.pop("time"))} if "time" in given else {}
    return {"gpus_per_node": int(bool(workers.gpus)), **minutes, **{f"slurm_{k}": v for k, v in given.items()}}
