"""When a training has nothing more to gain: looks at its error, and the rule that ends it."""

import math
import operator

from .config import Config


class EarlyStop:
    """Ends a training after schedule.early_stop looks in a row that gained less than schedule.early_stop_gain.

    A look comes every schedule.early_stop_every iterations, once the photos are at their full size and all degrees of
    the harmonics had their time: before, an error that stands still says nothing about the end.
    figure: decibels, higher is better. stopped_at: the iteration that ended the training, or None.
    """

    def __init__(self, config: Config):
        schedule = config.schedule
        self.patience, self.gain = schedule.early_stop, schedule.early_stop_gain
        self.every = config.scaled(schedule.early_stop_every)
        degrees = (config.model.harmonics_degree + 1) * config.scaled(schedule.harmonics_every)
        coarse = schedule.coarse_levels * config.scaled(schedule.coarse_every)
        self.first = max(degrees, coarse)
        self.best, self.idle, self.stopped_at = -math.inf, 0, None

    def is_due(self, iteration: int) -> bool:
        """Whether a look is to be taken after this iteration."""
        return self.patience > 0 and iteration % self.every == 0

    def look(self, iteration: int, figure: float) -> None:
        """Takes note of the figure at an iteration."""
        if iteration <= self.first or not math.isfinite(figure):
            return
        if figure >= self.best + self.gain:
            self.best, self.idle = figure, 0
            return
        self.idle += 1
        if self.idle >= self.patience:
            self.stopped_at = iteration

    def state(self) -> dict:
        """Plain values, for a checkpoint."""
        best = self.best if math.isfinite(self.best) else None
        return {"best": best, "idle": self.idle, "stopped_at": self.stopped_at}

    def load_state(self, state: dict) -> None:
        """Takes up what state() gave."""
        best = state["best"]
        self.best = -math.inf if best is None else float(best)
        self.idle = operator.index(state["idle"])
        stopped = state["stopped_at"]
        self.stopped_at = None if stopped is None else operator.index(stopped)
