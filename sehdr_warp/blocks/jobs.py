"""Run the blocks of a plan as jobs of submitit: processes of this machine, or jobs of a SLURM cluster.

A finished block is never run again. A job that dies (a crash, a lost node) is submitted again and continues from
its newest checkpoint; SLURM jobs that reach their time limit or are preempted are requeued by submitit.
"""

import logging
import os
import platform
import re
import secrets
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from ..errors import SehdrError, require_extra
from ..parallel import thread_count
from ..training.launch import installed_versions
from .block_plan import BlockPlan
from .job import FOLDER, BlockResult, folder_of, is_finished
from .submitted import BlockJob

log = logging.getLogger(__name__)

TRIES = 3  # Times that a block is started without getting any further; another try does not remove such a cause
POLL, SLURM_POLL = 0.2, 2.0  # Seconds between looks at running jobs, and at files that SLURM jobs write
ARRIVES = 30.0  # Seconds until what a job wrote must be seen here
_DIGITS = 18  # Of a number for SLURM; Python converts no numbers of thousands of digits
MONTH = 30 * 24 * 60  # Minutes, for jobs of this machine, which have no time limit of their own
DAY = 24 * 60  # Minutes of a SLURM job, if none are named: partitions refuse jobs that may run much longer


def run_blocks(
    out: Path,
    plan: BlockPlan,
    *,
    device: torch.device,
    gpus: int = 1,
    slurm: Mapping[str, str] | None = None,
    slurm_device: str | None = None,
) -> None:
    """Train all blocks of a plan that are not finished; arguments as of train_in_blocks().

    On this machine, `gpus` blocks are trained at once; SLURM gets all.

    Raises:
        SehdrError: If submitit is missing, or if blocks cannot be trained, after all others have been.
    """
    queue = _Queue(out, plan)
    if queue.finished:
        log.info("%d of %d blocks are finished already", queue.finished, len(plan.blocks))
    if not queue.waiting:
        return
    slots = min(gpus, len(queue.waiting)) if slurm is None else len(queue.waiting)
    on_cpu = slurm_device == "cpu" if slurm is not None else device.type == "cpu"
    # A new folder, for logs and for pickled values that submitit exchanges: nobody can have prepared it.
    logs = out / FOLDER / "logs" / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(4)}"
    if slurm is None:
        executors = local_executors(logs, slots, visible_gpus(device, slots) if device.type == "cuda" else [])
    else:
        executors = [slurm_executor(logs, slurm, gpu=not on_cpu)] * slots
    arguments = ("cpu" if on_cpu else None), installed_versions()
    # Jobs that run beside each other on this machine share its processors.
    job = BlockJob(max(1, thread_count() // slots) if slurm is None and slots > 1 else None)
    running: dict[int, tuple[int, Any]] = {}
    notes = None
    if slurm is not None:
        from .slurm_states import WaitingNotes  # Needs submitit.

        notes = WaitingNotes()
    try:
        while queue.waiting or running:
            for slot in range(slots):
                if slot not in running and queue.waiting:
                    index = queue.start()
                    running[slot] = index, _submit(executors[slot], job, out.absolute(), index, *arguments)
                    log.info("%s: training begins, %d photos", plan.blocks[index].name, len(plan.blocks[index].views))
            time.sleep(POLL if slurm is None else SLURM_POLL)
            if notes is not None:
                notes.look([submitted.job_id for _, submitted in running.values()])
            for slot, (index, submitted) in list(running.items()):
                if submitted.done():
                    del running[slot]
                    queue.end(index, submitted)
    except BaseException:
        for _, submitted in running.values():
            submitted.cancel(check=False)
        raise
    queue.require_all()


class _Queue:
    """Blocks of a plan that wait, and how often each was started.

    Attributes:
        waiting: Indices of blocks to start, the longest first, so that none of them is left alone at the end.
        finished: Number of blocks that are trained.
    """

    def __init__(self, out: Path, plan: BlockPlan):
        """Queue the blocks that are not finished."""
        self._out, self._plan = out, plan
        unfinished = (index for index in range(len(plan.blocks)) if not is_finished(self._folder(index)))
        self.waiting = deque(sorted(unfinished, key=lambda index: -plan.blocks[index].fraction))
        self.finished = len(plan.blocks) - len(self.waiting)
        self._tries = dict.fromkeys(self.waiting, 0)
        self._checkpoints = {index: _newest_checkpoint(self._folder(index)) for index in self.waiting}
        self._errors: dict[str, str] = {}

    def _folder(self, index: int) -> Path:
        return folder_of(self._out, self._plan, index)

    def start(self) -> int:
        """Return the index of the next block, which is no longer waiting."""
        index = self.waiting.popleft()
        self._tries[index] += 1
        return index

    def end(self, index: int, submitted: Any) -> None:
        """Count a block whose job has ended; queue it again if its process died, unless TRIES got no further."""
        name, folder = self._plan.blocks[index].name, self._folder(index)
        error = _error_of(submitted, folder)
        if (newest := _newest_checkpoint(folder)) != self._checkpoints[index]:
            self._tries[index], self._checkpoints[index] = 0, newest
        if error is None:
            self.finished += 1
            log.info("%s: finished, %d of %d", name, self.finished, len(self._plan.blocks))
        elif submitted.exception() is not None and self._tries[index] < TRIES:
            log.warning("%s: %s; it continues from its newest checkpoint", name, error)
            self.waiting.append(index)
        else:
            log.info("%s: cannot be trained: %s", name, error)
            self._errors[name] = error

    def require_all(self) -> None:
        """Raise SehdrError, which names a block and counts the others, if some cannot be trained."""
        if not self._errors:
            return
        name, error = next(iter(self._errors.items()))
        others = f" and {len(self._errors) - 1} more blocks" if len(self._errors) > 1 else ""
        progress = f"{self.finished} of {len(self._plan.blocks)} blocks are finished"
        remedy = f"--resume trains the others (logs in {self._out / FOLDER / 'logs'})"
        raise SehdrError(f"{name}{others}: {error}; {progress}; {remedy}")


def _newest_checkpoint(folder: Path) -> str:
    """Return the name of the newest checkpoint in a run folder; empty if there is none."""
    return max((path.name for path in folder.glob("checkpoints/iteration_*")), default="")


def _submit(executor: Any, job: BlockJob, *arguments: Any) -> Any:
    """Submit a block's job; raise SehdrError if SLURM refuses it."""
    from submitit.core.utils import FailedJobError

    try:
        return executor.submit(job, *arguments)
    except (FailedJobError, OSError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        remedy = "check what --slurm asks for; --device cpu asks for no GPU"
        raise SehdrError(f"SLURM does not take a job ({lines[-1]:.200}); {remedy}") from None


def check_devices(device: torch.device, count: int) -> None:
    """Raise SehdrError if this machine has too few GPUs, or processors, for `count` blocks at once."""
    if device.type == "cpu":
        if count > (most := max(2, os.cpu_count() or 1)):
            raise SehdrError(
                f"--gpus {count}: too many blocks at once for {os.cpu_count()} processors; use {most} at most"
            )
    elif (device.index or 0) + count > (there := torch.cuda.device_count()):
        first = f" from cuda:{device.index} on" if device.index else ""
        there -= device.index or 0
        raise SehdrError(f"--gpus {count}: there are {there} GPUs{first}, and each block takes one; use --gpus {there}")


def visible_gpus(device: torch.device, count: int) -> list[str]:
    """Return the names that CUDA_VISIBLE_DEVICES has for `count` GPUs from `device` on."""
    first, visible = device.index or 0, os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(index) for index in range(first + count)]
    return [name.strip() for name in names[first : first + count]]


def local_executors(logs: Path, slots: int, gpus: Sequence[str]) -> list[Any]:
    """Return an executor of submitit for each of `slots` jobs that may run at the same time on this machine.

    `gpus` are names of GPUs as in CUDA_VISIBLE_DEVICES, one for each job in turn; none for jobs without a GPU.
    """
    submitit = _submitit()
    executors = [submitit.LocalExecutor(folder=logs) for _ in range(slots)]
    for index, executor in enumerate(executors):
        executor.update_parameters(timeout_min=MONTH)
        if gpus:
            # submitit hides all GPUs from a job that asks for none. It wants numbers there, but passes names on, too.
            executor.update_parameters(gpus_per_node=1)
            executor.parameters["visible_gpus"] = [gpus[index % len(gpus)]]
    return executors


def slurm_executor(logs: Path, options: Mapping[str, str], *, gpu: bool) -> Any:
    """Return submitit's executor for SLURM; raise SehdrError if SLURM is missing or does not know an option."""
    submitit = _submitit()
    from .slurm_states import job_watcher

    try:
        executor = submitit.AutoExecutor(folder=logs, cluster="slurm")
        executor.update_parameters(name="sehdr-warp", **slurm_parameters(options, gpu=gpu))
    except (RuntimeError, ValueError, NameError, TypeError, AssertionError) as error:
        problem = (str(error).splitlines() or [type(error).__name__])[0].partition(". Valid")[0]
        raise SehdrError(
            f"--slurm cannot be used ({problem:.200}); it needs srun, and names that sbatch knows"
        ) from None
    submitit.SlurmJob.watcher = job_watcher()
    return executor


def _submitit() -> Any:
    """Return the package submitit; raise SehdrError if it is not installed."""
    return require_extra("submitit", "submitit, which runs trainings as jobs, is not installed", "blocks")


def slurm_parameters(options: Mapping[str, str], *, gpu: bool) -> dict[str, Any]:
    """Return the parameters of submitit for SLURM: one GPU a job, and `time` in minutes."""
    parameters: dict[str, Any] = {"timeout_min": DAY} | ({"gpus_per_node": 1} if gpu else {})
    for name, text in options.items():
        value = int(text) if text.isdecimal() and len(text) <= _DIGITS else text
        own = {"time": "timeout_min"}.get(name, name)
        if own == "timeout_min" and not isinstance(value, int):
            raise SehdrError(f"--slurm time={text:.100} is not a number of minutes; write time=240 for four hours")
        parameters[own if own in parameters else f"slurm_{own}"] = value
        if own == "cpus_per_task":  # Since SLURM 22.05, srun does not take it over from sbatch.
            parameters["slurm_srun_args"] = [f"--cpus-per-task={value}"]
    return parameters


def _error_of(job: Any, folder: Path) -> str | None:
    """Return why a job ended without a trained block in its folder, in one line; None if the block is trained."""
    exception = job.exception()
    if exception is not None:
        if (state := re.search(r"has not produced any output \(state: (\w+)", str(exception))) is not None:
            return f"its process ended without a result (job {job.job_id}, state {state[1]})"
        # submitit reports a traceback between two rules, or in its first line what else became of the job.
        lines = [line.strip() for line in str(exception).splitlines() if line.strip()] or [type(exception).__name__]
        rules = [number for number, line in enumerate(lines) if set(line) == {"-"}]
        return f"its process died ({lines[rules[-1] - 1 if len(rules) > 1 else 0][:200]})"
    result: BlockResult = job.result()
    where = "" if result.node == platform.node() else f"node {result.node}: "
    if result.error is not None:
        return where + result.error
    until = time.monotonic() + ARRIVES
    while not is_finished(folder):  # Other nodes may see what one has written a little later.
        if time.monotonic() > until:
            problem = f"{where}trained it, and {folder} does not hold the trained run: the file system has lost it"
            return f"{problem}; put the run on one that keeps what is written, and that all nodes share"
        time.sleep(POLL)
    return None
