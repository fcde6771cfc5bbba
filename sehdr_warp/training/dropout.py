"""DropGaussian: leave Gaussians out of steps at random, so that few photos are not fitted one by one."""

import torch
from torch import Tensor

from .strategies import SEED_STRIDE


class Dropout:
    """Leaves a share of the Gaussians out of each step (Park et al., DropGaussian, CVPR 2025).

    The share grows from 0 to `share` over the training. The opacities of the others are divided by what is left, so
    that the mean opacity of each Gaussian stays.

    Attributes:
        factors: [N] factors of the next step on the opacities, 0 for Gaussians that are left out; None without dropout.
    """

    def __init__(self, share: float, random_seed: int, total: int, device: torch.device):
        """Prepare for a training of `total` iterations."""
        self.factors: Tensor | None = None
        self._share, self._random_seed, self._total = share, random_seed, total
        self._generator = torch.Generator(device)

    def draw(self, iteration: int, rows: int) -> None:
        """Draw the Gaussians of the step that ends at an iteration; the same in a resumed training.

        `rows` is N, with reserved rows. The factors keep their memory while it stays, because CUDA graphs read it.
        """
        if not self._share:
            return
        if self.factors is None or len(self.factors) != rows:
            self.factors = torch.empty(rows, device=self._generator.device)
        left = 1 - self._share * iteration / self._total
        self._generator.manual_seed((self._random_seed * SEED_STRIDE + iteration) % 2**63)
        self.factors.bernoulli_(left, generator=self._generator).div_(left)
