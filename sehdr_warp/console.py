"""Progress of a command on the terminal.

The library's log goes to standard error as plain lines; stages of long work and a training have a progress bar on a
terminal.
"""

import logging
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from .errors import visible
from .progress import LINE_INTERVAL, Stage, display_stages, format_seconds

BAR_INTERVAL = 0.25  # Least seconds between updates of the bar. Each reads the loss, which waits for the device.
READ_INTERVAL = 2.0  # Least seconds between two readings of the figures for plain lines, of which a line shows the mean
MEAN_OF = 20
"""Readings of loss and PSNR that their running mean is over: each is of one photo, and photos differ by decibels."""
MAX_READING_SHARE = 1 / 20  # Part of the time that reading figures for updates may take


class _LogLines(logging.Handler):
    """Writes to the current sys.stderr, which a live bar replaces to put lines above itself."""

    def emit(self, record: logging.LogRecord) -> None:
        print(visible(self.format(record)), file=sys.stderr, flush=True)


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
    if level != "debug":  # Of a damaged photo, which the package names itself.
        logging.getLogger("PIL").setLevel(logging.CRITICAL)


def run_with_progress(steps: Iterable[Any], total: int) -> None:
    """Run the steps of a training and show its progress, unless the log is quiet.

    Args:
        steps: yields a TrainingProgress after each iteration. Its loss, psnr and gaussians are read only to be shown.
        total: number of iterations.
    """
    if not logging.getLogger("sehdr_warp").isEnabledFor(logging.INFO):
        deque(steps, maxlen=0)
        return
    terminal = sys.stderr.isatty()
    read_interval, read_due, show_due, start = (BAR_INTERVAL if terminal else READ_INTERVAL), 0.0, 0.0, None
    losses, psnrs = deque[float](maxlen=MEAN_OF), deque[float](maxlen=MEAN_OF)
    with _bar(total) if terminal else nullcontext(_log_line) as show:
        for step in steps:
            now = time.monotonic()
            # The rate is counted from the first step on, because that one waits for the compilation of kernels.
            start = start or (step.iteration, now)
            if now < read_due and step.iteration < total:
                continue
            losses.append(step.loss)
            psnrs.append(step.psnr)
            if terminal or now >= show_due or step.iteration >= total:
                rate = (step.iteration - start[0]) / max(now - start[1], 1e-9)
                usable = [value for value in psnrs if math.isfinite(value)]  # A photo that its mask excludes has none.
                psnr = sum(usable) / len(usable) if usable else math.nan
                show(step, rate=rate, loss=sum(losses) / len(losses), psnr=psnr)
                show_due = now + LINE_INTERVAL
            reading = time.monotonic() - now
            read_due = time.monotonic() + max(read_interval, min(reading / MAX_READING_SHARE, LINE_INTERVAL))


def _log_line(step: Any, *, rate: float, loss: float, psnr: float) -> None:
    log = logging.getLogger("sehdr_warp.training")
    figures = f"loss {loss:.4f}, PSNR {psnr:.2f} dB, {step.gaussians} Gaussians"
    log.info("iteration %d/%d, %s, %s left", step.iteration, step.total, figures, format_seconds(step.seconds_left))


@contextmanager
def stages_on_terminal() -> Iterator[None]:
    """Show each stage of the work within the block as a line that changes, if standard error is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    lines = _StageLines()
    try:
        with display_stages(lines.show):
            yield
    finally:
        lines.close()


class _StageLines:
    """Shows stages on a terminal, one line each."""

    def __init__(self):
        self._bar, self._stage = None, None

    def show(self, stage: Stage) -> None:
        """Show a stage that starts, goes on or ends."""
        if stage is not self._stage and not stage.ended:
            self.close()
            self._open(stage)
        if stage is self._stage and self._bar is not None:
            left = format_seconds(stage.seconds) if stage.ended else f"{format_seconds(stage.seconds_left)} left"
            training = "" if stage.ended or stage.training_in is None else format_seconds(stage.training_in)
            training = training and f"training in {training}"
            self._bar.update(self._bar.task_ids[0], completed=stage.done, left=left, training=training)
            if stage.ended:
                self.close()

    def close(self) -> None:
        """Leave the line as it is; what follows comes below it."""
        if self._bar is not None:
            self._bar.stop()
        self._bar, self._stage = None, None

    def _open(self, stage: Stage) -> None:
        parts = "{task.description}", "{task.completed}/{task.total}", "{task.fields[left]}", "{task.fields[training]}"
        self._bar, self._stage = _new_bar(*parts, width=20), stage
        self._bar.add_task(stage.activity, total=stage.total or None, left="", training="")
        self._bar.start()


def _new_bar(*parts: str, width: int | None) -> Any:
    """Return a progress bar of rich with the bar, `width` columns wide, after the first part; None fills the line."""
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, TextColumn
    from rich.progress import Progress as Bar

    columns: list[ProgressColumn] = [TextColumn(part, markup=False) for part in parts]
    columns.insert(1, BarColumn(width))
    return Bar(*columns, console=Console(file=sys.stderr), expand=width is None)


@contextmanager
def _bar(total: int) -> Iterator[Callable[..., None]]:
    """Show a bar, and yield the function that updates it after a step: from it and running means of its figures."""
    # rich cuts columns on the right if the terminal is narrow, so the most important ones come first.
    parts = "{task.completed}/{task.total}", "{task.fields[rate]}", "{task.fields[left]} left", "{task.fields[figures]}"
    with _new_bar(*parts, width=None) as bar:
        console, task = bar.console, bar.add_task("train", total=total, rate="", left="-:--", figures="")

        def show(step: Any, *, rate: float, loss: float, psnr: float) -> None:
            gaussians = step.gaussians
            count = f"{gaussians / 1000:.1f}k" if gaussians >= 10_000 else str(gaussians)
            figures = f"loss {loss:.3f} {psnr:.1f} dB {count}" if console.width >= 75 else f"{psnr:.1f} dB {count}"
            if console.width >= 90:
                figures = f"loss {loss:.4f}  PSNR {psnr:.2f} dB  {count} Gaussians"
            speed, left = f"{rate:.3g} it/s" if rate else "", format_seconds(step.seconds_left)
            bar.update(task, completed=step.iteration, rate=speed, left=left, figures=figures)
            if step.iteration >= total:
                bar.stop()  # The stages of the end have lines of their own.

        yield show
