"""The moving average of the Gaussians (EMA), which is the trained scene."""

import torch
from torch import Tensor

from ..model.gaussians import Gaussians
from ..runs.config import Config

SAMPLES_PER_WINDOW = 10  # Consecutive iterations differ too little to be worth the time
WINDOWS = 5  # Windows before the end at which the average begins; older samples would weigh less than 1 %


class MovingAverage:
    """Exponential moving average of Gaussians over about schedule.ema_window of the last iterations.

    With it no single photo dominates the end of a training. It starts after the last change of the number of Gaussians.

    Attributes:
        every: Iterations between samples.
        weight: Weight of a new sample; 1 disables the average.
        first: Iteration after which samples are taken.
        means: The averages by parameter name; empty before the first sample.
    """

    def __init__(self, config: Config, last_change: int):
        """Create an average without samples; `last_change` is the last iteration that changes the Gaussians' number."""
        self.total = config.schedule.iterations
        window = config.scaled(config.schedule.ema_window) if config.schedule.ema_window else 1
        self.every = max(1, window // SAMPLES_PER_WINDOW)
        self.weight = self.every / window
        self.first = max(self.total - WINDOWS * window, last_change)
        self.means: dict[str, Tensor] = {}

    @torch.no_grad()
    def update(self, iteration: int, step_batch: int, gaussians: Gaussians) -> None:
        """Update the average after a step of `step_batch` iterations; after the last one, copy it to the Gaussians."""
        if self.weight == 1 or iteration <= self.first:
            return
        if iteration % self.every < step_batch or iteration >= self.total:
            now = gaussians.tensors()
            if self.means:
                # A plain mean at first, so that the first sample does not weigh more than others.
                samples = iteration // self.every - self.first // self.every + (iteration % self.every >= step_batch)
                means = [self.means[name] for name in now]
                torch._foreach_lerp_(means, list(now.values()), max(self.weight, 1 / max(1, samples)))
            else:
                self.means = {name: values.clone() for name, values in now.items()}
        if iteration >= self.total:
            for name, values in gaussians.tensors().items():
                values.copy_(self.means[name])
            self.means = {}
