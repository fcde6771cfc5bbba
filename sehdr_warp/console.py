"""Progress of a command on the terminal.

The library's log goes to standard error as plain lines; a training on a terminal has a progress bar.
"""

import logging
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any, NamedTuple

LINE_INTERVAL = 10.0
"""Seconds between lines about a training if standard error is not a terminal."""
BAR_INTERVAL = 0.25
"""Least seconds between updates of the bar. Each reads the loss, which waits for the device."""
MAX_READING_SHARE = 1 / 20
"""Part of the time that reading figures for updates may take."""


class Progress(NamedTuple):
    """A training's progress, as it is shown."""

    iteration: int
    rate: float
    """Iterations a second."""
    seconds_left: float | None
    loss: float
    psnr: float
    """PSNR of the last photo, dB."""
    gaussians: int


class _LogLines(logging.Handler):
    """Writes to the current sys.stderr, which a live bar replaces to put lines above itself."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr, flush=True)


def show_logs(level: str = "info") -> None:
    """Show the package's log on standard error.

    Args:
        level: "warning" for warnings and errors alone, "info", or "debug" for all with the name of each logger.
    """
    logger = logging.getLogger("sehdr_warp")
    handler = _LogLines()
    handler.setFormatter(logging.Formatter("%(name)s: %(message)s" if level == "debug" else "%(message)s"))
    logger.handlers = [other for other in logger.handlers if not isinstance(other, _LogLines)] + [handler]
    logger.setLevel(level.upper())
    logger.propagate = False


def follow(steps: Iterable[Any], total: int) -> None:
    """Run the steps of a training and show its progress, unless the log is quiet.

    Args:
        steps: yields a Step after each iteration. Its loss, psnr and gaussians are read only to be shown.
        total: number of iterations.
    """
    if not logging.getLogger("sehdr_warp").isEnabledFor(logging.INFO):
        deque(steps, maxlen=0)
        return
    terminal = sys.stderr.isatty()
    interval, due, start = (BAR_INTERVAL if terminal else LINE_INTERVAL), 0.0, None
    with _bar(total) if terminal else nullcontext(partial(_log_line, total)) as show:
        for step in steps:
            now = time.monotonic()
            # The rate is counted from the first step on, because that one waits for the compilation of kernels.
            start = start or (step.iteration, now)
            if now < due and step.iteration < total:
                continue
            rate = (step.iteration - start[0]) / max(now - start[1], 1e-9)
            show(Progress(step.iteration, rate, step.seconds_left, step.loss, step.psnr, step.gaussians))
            reading = time.monotonic() - now
            due = time.monotonic() + max(interval, min(reading / MAX_READING_SHARE, LINE_INTERVAL))


def _log_line(total: int, progress: Progress) -> None:
    figures = f"loss {progress.loss:.4f}, PSNR {progress.psnr:.2f} dB, {progress.gaussians} Gaussians"
    log = logging.getLogger("sehdr_warp.training")
    log.info("iteration %d/%d, %s, %s left", progress.iteration, total, figures, format_seconds(progress.seconds_left))


@contextmanager
def _bar(total: int) -> Iterator[Callable[[Progress], None]]:
    """Show a bar, and yield the function that updates it."""
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, TextColumn
    from rich.progress import Progress as Bar

    console = Console(file=sys.stderr)
    # rich cuts columns on the right if the terminal is narrow, so the most important ones come first.
    parts = "{task.completed}/{task.total}", "{task.fields[rate]}", "{task.fields[left]} left", "{task.fields[figures]}"
    columns: list[ProgressColumn] = [TextColumn(part, markup=False) for part in parts]
    columns.insert(1, BarColumn(None))
    with Bar(*columns, console=console, expand=True) as bar:
        task = bar.add_task("train", total=total, rate="", left="-:--", figures="")

        def show(progress: Progress) -> None:
            loss, psnr, gaussians = progress.loss, progress.psnr, progress.gaussians
            count = f"{gaussians / 1000:.1f}k" if gaussians >= 10_000 else str(gaussians)
            figures = f"loss {loss:.3f} {psnr:.1f} dB {count}" if console.width >= 75 else f"{psnr:.1f} dB {count}"
            if console.width >= 90:
                figures = f"loss {loss:.4f}  PSNR {psnr:.2f} dB  {count} Gaussians"
            rate = f"{progress.rate:.3g} it/s" if progress.rate else ""
            left = format_seconds(progress.seconds_left)
            bar.update(task, completed=progress.iteration, rate=rate, left=left, figures=figures)

        yield show


def format_seconds(seconds: float | None) -> str:
    """Return `1:23` or `1:02:03`, or `-:--` for None."""
    if seconds is None:
        return "-:--"
    minutes, seconds_part = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds_part:02}" if hours else f"{minutes}:{seconds_part:02}"
