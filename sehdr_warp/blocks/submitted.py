"""Run a job of submitit in a process of its own. Nothing else is imported, so that torch loads after the settings."""

import os
from pathlib import Path
from typing import Any


class BlockJob:
    """A block's training as a job; checkpoint() makes SLURM requeue a job whose time is over."""

    def __init__(self, threads: int | None = None):
        """Set the threads that the job may use on the CPU; None for all of its machine."""
        self.threads = threads

    def __call__(self, out: Path, index: int, device: str | None, photo_storage: str, versions: str) -> Any:
        """Train the block; arguments and result as of train_block()."""
        from ..process import calm_threads, collect_late

        if self.threads is not None:
            os.environ["SEHDR_THREADS"] = str(self.threads)
        calm_threads()
        collect_late()
        from .job import train_block

        return train_block(out, index, device, photo_storage, versions)

    def checkpoint(self, *arguments: Any) -> Any:
        """Return the same job: its training continues from its newest checkpoint."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, *arguments)
