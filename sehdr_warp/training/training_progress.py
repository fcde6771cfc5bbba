"""Progress of a training, which `for progress in trainer` yields."""

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
        return self._trainer.loss

    @property
    def psnr(self) -> float:
        """PSNR of the step's photo, dB."""
        return self._trainer.psnr()

    @property
    def gaussians(self) -> int:
        """Number of Gaussians."""
        return self._trainer.field.gaussians.count
