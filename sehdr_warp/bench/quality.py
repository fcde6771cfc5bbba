"""`bench quality`: how good each method is, job by job, and the tables and plots of all jobs in a folder."""

from collections.abc import Callable
from pathlib import Path

from ..errors import SehdrError
from .quality_jobs import Job, Settings, plan_jobs, read_failure, read_result
from .quality_pool import Workers, run_jobs
from .quality_report import TABLES, write_quality_report


def bench_quality(
    settings: Settings, out: Path, workers: Workers, *, progress: Callable[[str], None] = lambda line: None
) -> tuple[str, SehdrError | None]:
    """Runs every job of the settings that has no result in `out`, then writes and returns the tables of all that are
    there; with them the error to end with, if a job failed.

    Raises SehdrError for settings that cannot be run, before anything runs.
    """
    jobs = plan_jobs(settings, progress=progress)
    try:
        run_jobs(jobs, out, workers, settings.device, progress)
    except BaseException:
        # Interrupted or not: what is finished is in the tables.
        if (out / "jobs").is_dir():
            write_quality_report(out)
        raise
    return write_quality_report(out), _failure(jobs, out)


def _failure(jobs: list[Job], out: Path) -> SehdrError | None:
    folders = [out / "jobs" / job.name for job in jobs]
    failed = [read_failure(folder) for folder in folders if read_result(folder) is None]
    if not failed:
        return None
    error = failed[0]["error"] if failed[0] else "it has no result"
    return SehdrError(
        f"{len(failed)} of {len(jobs)} jobs failed, the first with: {error} (all in {out / TABLES}; the same command "
        "tries them again)"
    )
