"""Run a job of submitit in a process of its own. Nothing else is imported, so that torch loads after the settings."""

import os
import signal
import threading
from pathlib import Path
from typing import Any


class BlockJob:
    """A block's training as a job.

    SLURM announces the end of a job's time by a signal, for which submitit calls checkpoint() and requeues the job.
    That waits until the training has ended and saved.
    """

    def __init__(self, threads: int | None = None):
        """Set the threads that the job may use on the CPU; None for all of its machine."""
        self.threads = threads

    def __call__(self, out: Path, index: int, device: str | None, versions: str) -> Any:
        """Train the block; arguments and result as of train_block()."""
        requeue, is_over = signal.getsignal(signal.SIGUSR2), threading.Event()
        if callable(requeue):  # submitit's, in jobs of SLURM.
            signal.signal(signal.SIGUSR2, lambda *_: is_over.set())
        from ..process import calm_threads, collect_late

        if self.threads is not None:
            os.environ["SEHDR_THREADS"] = str(self.threads)
        calm_threads()
        collect_late()
        from .job import StoppedTraining, train_block

        try:
            return train_block(out, index, device, versions, is_over)
        except StoppedTraining:
            if is_over.is_set() and callable(requeue):
                requeue(signal.SIGUSR2, None)  # Does not return.
            raise

    def checkpoint(self, *arguments: Any) -> Any:
        """Return the same job: its training continues from its newest checkpoint."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, *arguments)
