"""Progress of long work as stages: how much is done, and how long the rest takes.

Library code counts what is done. A command line on a terminal shows a stage as one line that changes; anywhere else a
stage is a log line when it starts, and one every LINE_INTERVAL seconds.
"""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
LINE_INTERVAL = 10.0  # Seconds between log lines about a stage

Display = Callable[["Stage"], None]
_displays: list[Display] = []  # Displays that show stages in place of log lines; the last one is used


class Stage:
    """A part of long work that consists of equal steps.

    Attributes:
        activity: What is done, such as "finding features in photos".
        total: Number of steps, 0 if it is not known.
        done: Number of steps done.
        later: Expected seconds of the work between this stage and the training, None if that is not known.
        ended: Whether the stage has ended.
    """

    def __init__(self, activity: str, total: int, logger: logging.Logger):
        """Start a stage, and log or show that it starts."""
        self.activity, self.total, self.done, self.ended = activity, total, 0, False
        self.later: float | None = None
        self._logger, self._start = logger, time.monotonic()
        self._line_due = self._start + LINE_INTERVAL
        self._show(f"{activity}: {total}" if total else activity)

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._start

    @property
    def seconds_left(self) -> float | None:
        """Estimated seconds to the end of the stage; None if no step is done, or the total is unknown."""
        return self.seconds / self.done * (self.total - self.done) if self.done and self.total else None

    @property
    def training_in(self) -> float | None:
        """Estimated seconds to the start of the training; None if that is not known."""
        return None if self.later is None or self.seconds_left is None else self.later + self.seconds_left

    def update(self, done: int) -> None:
        """Set the number of steps done, and log or show it."""
        self.done = min(done, self.total) if self.total else done
        if _displays or time.monotonic() >= self._line_due:
            self._line_due = time.monotonic() + LINE_INTERVAL
            self._show(self.line())

    def end(self) -> None:
        """End the stage."""
        self.ended = True
        if _displays:
            self._show("")

    def line(self) -> str:
        """Return the state in words: `finding features in photos: 8 of 21, 0:19 left`."""
        count = f"{self.done} of {self.total}" if self.total else str(self.done)
        remaining = "" if self.seconds_left is None else f", {format_seconds(self.seconds_left)} left"
        training = "" if self.training_in is None else f"; training starts in about {format_seconds(self.training_in)}"
        return f"{self.activity}: {count}{remaining}{training}"

    def _show(self, line: str) -> None:
        if not self._logger.isEnabledFor(logging.INFO):
            return
        if _displays:
            _displays[-1](self)
        else:
            self._logger.info("%s", line)


@contextmanager
def stage(activity: str, total: int, logger: logging.Logger) -> Iterator[Stage]:
    """Provide a stage that ends with the block."""
    started = Stage(activity, total, logger)
    try:
        yield started
    finally:
        started.end()


def track_progress(activity: str, items: Sequence[Item], logger: logging.Logger) -> Iterator[tuple[int, Item]]:
    """Enumerate items as a stage, of which each item is a step."""
    with stage(activity, len(items), logger) as progress:
        for index, item in enumerate(items):
            yield index, item
            progress.update(index + 1)


@contextmanager
def display_stages(display: Display) -> Iterator[None]:
    """Show stages by a function instead of log lines, within the block; it gets the stage at every change."""
    _displays.append(display)
    try:
        yield
    finally:
        _displays.remove(display)


def format_seconds(seconds: float | None) -> str:
    """Return a clock, which may count down: `1:23` or `1:02:03`, or `-:--` for None."""
    if seconds is None:
        return "-:--"
    minutes, seconds_part = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds_part:02}" if hours else f"{minutes}:{seconds_part:02}"


def format_duration(seconds: float) -> str:
    """Return a duration in words of one unit, such as `45 s`, `3.3 min` or `2.1 h`."""
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}" if seconds < 20 * size else f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
