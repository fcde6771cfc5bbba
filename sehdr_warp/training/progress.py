"""What a training tells while it runs: a bar on a terminal, plain lines elsewhere."""

import sys
import time

PLAIN_EVERY = 10.0
"""Seconds between plain lines."""
BAR_EVERY = 0.5
"""Seconds between updates of a bar. A report renders, which may take as long as a step does: where it takes a twentieth
of these seconds or more, they are so many more, up to PLAIN_EVERY."""


class Progress:
    """Reports on a training of `total` iterations on standard error.

    enabled: False says nothing at all. Use as a context manager; ask is_due() before what a report takes,
    then update().
    """

    def __init__(self, total: int, *, enabled: bool = True):
        self.total = total
        self.stream = sys.stderr
        self.enabled = enabled
        self._bar = self._task = None
        self._last_line = self._asked = self._cost = 0.0

    def __enter__(self):
        if self.enabled and self.stream.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            self._bar = Progress(
                TextColumn("train"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[figures]}"),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=Console(file=self.stream),
                transient=False,
            )
            self._task = self._bar.add_task("train", total=self.total, figures="")
            self._bar.start()
        return self

    def __exit__(self, *_):
        if self._bar is not None:
            self._bar.stop()

    def is_due(self, iteration: int) -> bool:
        """Whether an update would show: on a terminal every BAR_EVERY seconds, else every PLAIN_EVERY; what is done
        from here to the update is its cost."""
        if not self.enabled:
            return False
        self._asked = time.monotonic()
        interval = PLAIN_EVERY if self._bar is None else min(max(BAR_EVERY, 20 * self._cost), PLAIN_EVERY)
        return iteration == self.total or self._asked - self._last_line >= interval

    def update(self, iteration: int, *, loss: float, psnr: float, count: int, seconds_left: float) -> None:
        """loss and PSNR (dB) of the last photo, Gaussians, and the expected seconds to the end."""
        self._last_line = time.monotonic()
        self._cost = self._last_line - self._asked
        figures = f"loss {loss:.4f}  PSNR {psnr:.2f} dB  {count} Gaussians"
        if self._bar is not None:
            self._bar.update(self._task, completed=iteration, figures=figures)
        elif self.enabled:
            self.note(f"iteration {iteration}/{self.total}  {figures}  {seconds_left:.0f} s left")

    def note(self, line: str) -> None:
        """A line that stays."""
        if self._bar is not None:
            self._bar.console.print(line, highlight=False, markup=False)
        elif self.enabled:
            print(line, file=self.stream, flush=True)
