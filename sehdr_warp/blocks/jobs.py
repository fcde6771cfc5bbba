"""Run the blocks of a plan as jobs of submitit: processes of this machine, or jobs of a SLURM cluster.

A finished block is never run again. A job that dies (a crash, a lost node) is submitted again and continues from
its newest checkpoint; SLURM jobs that reach their time limit or are preempted are requeued by submitit.
"""

import logging
import os
import secrets
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ..errors import SehdrError
from .block_plan import BlockPlan
from .job import FOLDER, BlockResult, folder_of, is_finished, train_block

log = logging.getLogger(__name__)

TRIES = 3  # Times that a block is started; a training that dies each time has a cause that another try does not remove
POLL = 1.0  # Seconds between looks at running jobs
MONTH = 30 * 24 * 60  # Minutes, for jobs of this machine, which have no time limit of their own


class BlockJob:
    """A block's training as submitit runs it; checkpoint() makes SLURM requeue a job whose time is over."""

    def __call__(self, *arguments: Any) -> BlockResult:
        """Train the block; arguments as of train_block()."""
        return train_block(*arguments)

    def checkpoint(self, *arguments: Any) -> Any:
        """Return the same job: its training continues from its newest checkpoint."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, *arguments)


def run_blocks(
    out: Path,
    plan: BlockPlan,
    *,
    device: torch.device,
    gpus: int = 1,
    photos: str = "auto",
    slurm: Mapping[str, str] | None = None,
) -> None:
    """Train all blocks of a plan that are not finished.

    Args:
        out: Folder of the merged run, with blocks.json.
        plan: The plan.
        device: The CPU, or the first GPU to use.
        gpus: Blocks to train at once on this machine, each on a GPU of its own from `device` on. SLURM gets all at
            once.
        photos: Where photos are stored, see load_scene().
        slurm: Parameters of SLURM jobs, such as {"partition": "gpu"}; None for this machine.

    Raises:
        SehdrError: If submitit is missing, or if blocks cannot be trained, after all others have been.
    """
    waiting = deque(index for index in range(len(plan.blocks)) if not is_finished(folder_of(out, plan, index)))
    finished = len(plan.blocks) - len(waiting)
    if finished:
        log.info("%d of %d blocks are finished already", finished, len(plan.blocks))
    if not waiting:
        return
    slots = min(gpus, len(waiting)) if slurm is None else len(waiting)
    executors = _executors(out, device, slots, slurm)
    job_device = "cpu" if device.type == "cpu" else None
    tries, errors = dict.fromkeys(waiting, 0), {}
    running: dict[int, tuple[int, Any]] = {}
    try:
        while waiting or running:
            for slot in range(slots):
                if slot in running or not waiting:
                    continue
                index = waiting.popleft()
                tries[index] += 1
                running[slot] = index, executors[slot].submit(BlockJob(), out.absolute(), index, job_device, photos)
                log.info("%s: training begins, %d photos", plan.blocks[index].name, len(plan.blocks[index].views))
            time.sleep(POLL)
            for slot, (index, job) in list(running.items()):
                if not job.done():
                    continue
                del running[slot]
                name, error = plan.blocks[index].name, _error_of(job)
                if error is None:
                    finished += 1
                    log.info("%s: finished, %d of %d", name, finished, len(plan.blocks))
                elif job.exception() is not None and tries[index] < TRIES:
                    log.warning("%s: %s; it continues from its newest checkpoint", name, error)
                    waiting.append(index)
                else:
                    log.info("%s: cannot be trained: %s", name, error)
                    errors[name] = error
    except BaseException:
        for _, job in running.values():
            job.cancel(check=False)
        raise
    if errors:
        name, error = next(iter(errors.items()))
        others = f" and {len(errors) - 1} more blocks" if len(errors) > 1 else ""
        remedy = f"{finished} blocks are finished; --resume trains the others (logs in {out / FOLDER / 'logs'})"
        raise SehdrError(f"{name}{others}: {error}; {remedy}")


def visible_gpus(device: torch.device, count: int) -> list[str]:
    """Return the names that CUDA_VISIBLE_DEVICES has for `count` GPUs from `device` on."""
    first, visible = device.index or 0, os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(index) for index in range(first + count)]
    return [name.strip() for name in names[first : first + count]]


def _executors(out: Path, device: torch.device, slots: int, slurm: Mapping[str, str] | None) -> list[Any]:
    """Return an executor of submitit for each job that may run at the same time."""
    try:
        import submitit
    except ImportError:
        problem = "submitit, which runs blocks as jobs, is not installed"
        raise SehdrError(f"{problem}; run `pip install sehdr-warp[blocks]`") from None
    # submitit exchanges pickled values through this folder, so it is a new one that nobody can have prepared.
    logs = out / FOLDER / "logs" / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(4)}"
    if slurm is not None:
        executor = submitit.AutoExecutor(folder=logs, cluster="slurm")
        executor.update_parameters(name="sehdr-warp", **_slurm_parameters(slurm, gpu=device.type == "cuda"))
        return [executor] * slots
    executors = [submitit.LocalExecutor(folder=logs) for _ in range(slots)]
    for executor in executors:
        executor.update_parameters(timeout_min=MONTH)
    if device.type == "cuda":
        for executor, name in zip(executors, visible_gpus(device, slots), strict=True):
            # submitit hides all GPUs from a job that asks for none. It wants numbers there, but passes names on, too.
            executor.update_parameters(gpus_per_node=1)
            executor.parameters["visible_gpus"] = [name]
    return executors


def _slurm_parameters(options: Mapping[str, str], *, gpu: bool) -> dict[str, Any]:
    """Return the parameters of submitit for SLURM: one GPU a job, and `time` in minutes."""
    parameters: dict[str, Any] = {"timeout_min": MONTH} | ({"gpus_per_node": 1} if gpu else {})
    for name, text in options.items():
        value = int(text) if text.isdecimal() else text
        own = {"time": "timeout_min"}.get(name, name)
        parameters[own if own in parameters else f"slurm_{own}"] = value
    return parameters


def _error_of(job: Any) -> str | None:
    """Return why a job ended without a trained block, in one line; None if the block is trained."""
    exception = job.exception()
    if exception is None:
        return job.result().error
    lines = [line for line in str(exception).strip().splitlines() if line.strip()]
    return (
        f"its process died ({lines[-1].strip()[:200]})" if lines else f"its process died ({type(exception).__name__})"
    )
