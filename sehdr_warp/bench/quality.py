"""`bench quality`: how good each method is, job by job, and the tables and plots of all jobs in a folder."""

from collections.abc import Callable
from pathlib import Path

from ..errors import SehdrError
from .quality_jobs import Job, Settings, plan_jobs, read_failure, read_result
from .quality_pool import Workers, run_jobs
from .quality_report import TABLES, write_quality_report


def bench_quality(
    settings: Settings, out: Path, workers: Workers, *, progress: Callable[[str], None] = lambda line: None
) -> str:
    """Runs every job of the settings that has no result in `out`, then writes and returns the tables of all that are
    there.

    Raises SehdrError for settings that cannot be run, before anything runs; and, after everything is written, if a job
    failed.
    """
    jobs = plan_jobs(settings)
    try:
        run_jobs(jobs, out, workers, settings.device, progress)
    finally:
        # Interrupted or not: what is finished is in the tables.
        text = write_quality_report(out) if (out / "jobs").is_dir() else ""
    _require(jobs, out, text)
    return text


def _require(jobs: list[Job], out: Path, text: str) -> None:
    folders = [out / "jobs" / job.name for job in jobs]
    failed = [(folder, read_failure(folder)) for folder in folders if read_result(folder) is None]
    if failed:
        error = failed[0][1]["error"] if failed[0][1] else "it has no result"
        raise SehdrError(
            f"{len(failed)} of {len(jobs)} jobs failed, the first with: {error} (all in {out / TABLES}; the same command "
            "tries them again)"
        )
