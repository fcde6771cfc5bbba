"""Progress of a training: values after a step, and the time that is left."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .trainer import Trainer


class TrainingProgress:
    """Values of a training after a step.

    `loss`, `psnr` and `gaussians` are read from the device when they are accessed, until the next step.

    Attributes:
        iteration: Iterations done.
        total: Iterations in all.
        seconds: Duration of the training so far.
        seconds_left: Estimated time to the end; None after the first step.
    """

    def __init__(self, trainer: Trainer, seconds_left: float | None):
        """Take the values of a trainer after a step."""
        self._trainer = trainer
        self.iteration, self.total, self.seconds = trainer.iteration, trainer.total, trainer.seconds
        self.seconds_left = seconds_left

    def __repr__(self) -> str:
        """Return iteration and time; nothing is read from the device."""
        return f"TrainingProgress({self.iteration} of {self.total}, {self.seconds:.1f} s)"

    @property
    def loss(self) -> float:
        """Loss of the step."""
        return self._trainer.run_timed(lambda: self._trainer.loss)

    @property
    def psnr(self) -> float:
        """PSNR of the step's photo, dB."""
        return self._trainer.run_timed(self._trainer.psnr)

    @property
    def gaussians(self) -> int:
        """Number of Gaussians."""
        return self._trainer.field.gaussians.count


class Pace:
    """Seconds per iteration, smoothed, from which the time left is estimated."""

    def __init__(self) -> None:
        """Start without a measurement."""
        self._seconds_per_iteration = 0.0

    def seconds_left(self, trainer: Trainer, step_seconds: float) -> float | None:
        """Return the estimated time to the end of a training after a step; None after its first step.

        The first step compiles kernels, so that its duration says nothing.
        """
        steps_before = trainer.iteration - trainer.first_iteration - trainer.step_batch
        if steps_before == 0:
            return None
        per_iteration = step_seconds / trainer.step_batch
        self._seconds_per_iteration += (per_iteration - self._seconds_per_iteration) / min(steps_before, 100)
        # With the largest number of Gaussians, a step takes about twice as long as at the start.
        growing = trainer.field.gaussians.count < trainer.strategy.cap_max
        growth = max(0.0, 1 - trainer.iteration / trainer.strategy.schedule.stop) if growing else 0.0
        return self._seconds_per_iteration * (1 + growth) * (trainer.total - trainer.iteration)
