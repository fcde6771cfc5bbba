"""What a person sees while a command runs: the library's log as plain lines on standard error, on a terminal a bar."""

import logging
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial

LINE_EVERY = 10.0  # Seconds between lines about a training where there is no terminal
BAR_EVERY = 0.25  # Between updates of a bar, at least: each reads the loss, and takes a twentieth of the time at most


class _Lines(logging.Handler):
    """Writes to what standard error is now: a live bar puts lines above itself by taking its place."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr, flush=True)


def show_logs(level: str = "info") -> None:
    """Shows what the package logs: "warning" and above alone, "info", or "debug" with the name of each logger."""
    logger = logging.getLogger("sehdr_warp")
    handler = _Lines()
    handler.setFormatter(logging.Formatter("%(name)s: %(message)s" if level == "debug" else "%(message)s"))
    logger.handlers = [other for other in logger.handlers if not isinstance(other, _Lines)] + [handler]
    logger.setLevel(level.upper())
    logger.propagate = False


def follow(steps: Iterable, total: int) -> None:
    """Runs the steps of a Training and tells of them: a bar on a terminal, else a line every LINE_EVERY seconds. Loss,
    psnr and gaussians are read only where they are shown."""
    if not logging.getLogger("sehdr_warp").isEnabledFor(logging.INFO):
        deque(steps, maxlen=0)
        return
    terminal = sys.stderr.isatty()
    every, due, start = (BAR_EVERY if terminal else LINE_EVERY), 0.0, None
    with _bar(total) if terminal else nullcontext(partial(_show_line, total)) as show:
        for step in steps:
            now = time.monotonic()
            # The first step waits for the compiling of kernels, which says nothing of the pace.
            start = start or (step.iteration, now)
            if now < due and step.iteration < total:
                continue
            pace = (step.iteration - start[0]) / max(now - start[1], 1e-9)
            show(step.iteration, pace, step.seconds_left, step.loss, step.psnr, step.gaussians)
            due = time.monotonic() + max(every, min(20 * (time.monotonic() - now), LINE_EVERY))


def _show_line(total, iteration, pace, left, loss, psnr, gaussians) -> None:
    figures = f"loss {loss:.4f}, PSNR {psnr:.2f} dB, {gaussians} Gaussians"
    log = logging.getLogger("sehdr_warp.training")
    log.info("iteration %d/%d, %s, %s left", iteration, total, figures, format_seconds(left))


@contextmanager
def _bar(total: int) -> Iterator[Callable]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(file=sys.stderr)
    # What must never be cut comes first; the bar takes what is left.
    parts = "{task.completed}/{task.total}", "{task.fields[pace]}", "{task.fields[left]} left", "{task.fields[figures]}"
    columns = [TextColumn(part, markup=False) for part in parts]
    with Progress(*columns[:1], BarColumn(None), *columns[1:], console=console, expand=True) as progress:
        task = progress.add_task("train", total=total, pace="", left="-:--", figures="")

        def show(iteration, pace, left, loss, psnr, gaussians):
            count = f"{gaussians / 1000:.1f}k" if gaussians >= 10_000 else str(gaussians)
            figures = f"loss {loss:.3f} {psnr:.1f} dB {count}" if console.width >= 75 else f"{psnr:.1f} dB {count}"
            if console.width >= 90:
                figures = f"loss {loss:.4f}  PSNR {psnr:.2f} dB  {count} Gaussians"
            rate = f"{pace:.3g} it/s" if pace else ""
            progress.update(task, completed=iteration, pace=rate, left=format_seconds(left), figures=figures)

        yield show


def format_seconds(seconds: float | None) -> str:
    """`1:23` or `1:02:03`; `-:--` where it is not known."""
    if seconds is None:
        return "-:--"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
