"""What a training ends with: means of the Gaussians over its last steps, so that no photo has the last word."""

import torch
from torch import Tensor

from ..model.gaussians import Gaussians
from ..runs.config import Config

SAMPLES = 10  # Of a span, at even steps: neighbors differ too little to be worth the time
SPANS = 5  # From which a mean begins: what is older would weigh less than a hundredth


class Averaging:
    """Exponential means of Gaussians over about schedule.ema_window of the last iterations, once their count stays."""

    def __init__(self, config: Config, last_change: int):
        self.total = config.schedule.iterations
        span = config.scaled(config.schedule.ema_window) if config.schedule.ema_window else 1
        self.every = max(1, span // SAMPLES)
        self.part = self.every / span
        self.first = max(self.total - SPANS * span, last_change)
        self.means: dict[str, Tensor] = {}

    @torch.no_grad()
    def follow(self, iteration: int, photos: int, gaussians: Gaussians) -> None:
        """After a step that made so many iterations: notes the Gaussians; at the end makes them their means."""
        if self.part == 1 or iteration <= self.first:
            return
        if iteration % self.every < photos or iteration >= self.total:
            now = gaussians.tensors()
            if self.means:
                # At first plainly, so that the first of all does not weigh more than others.
                seen = (iteration - self.first) // self.every
                means = [self.means[name] for name in now]
                torch._foreach_lerp_(means, list(now.values()), max(self.part, 1 / (seen + 1)))
            else:
                self.means = {name: values.clone() for name, values in now.items()}
        if iteration >= self.total:
            for name, values in gaussians.tensors().items():
                values.copy_(self.means[name])
            self.means = {}

    def state(self) -> dict[str, Tensor]:
        """The means, for a checkpoint."""
        return self.means

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Takes up the means of state()."""
        self.means = state
