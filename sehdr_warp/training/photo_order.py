"""The order of training photos: all photos in random order, then again in another order."""

import operator

import torch
from torch import Tensor


class PhotoOrder:
    """The order of `count` photos; all ranks draw the same order, and each takes its own photo of a step."""

    def __init__(self, count: int, seed: int, rank: int = 0, ranks: int = 1):
        """Create an order.

        Args:
            count: Number of photos.
            seed: Seed of the order.
            rank: Number of this process.
            ranks: Number of processes that train together.
        """
        self._count, self._rank, self._ranks = count, rank, ranks
        self._remaining: list[int] = []
        self._generator = torch.Generator().manual_seed(seed)

    def next(self) -> int:
        """Return the index of this rank's next photo."""
        batch = []
        for _ in range(self._ranks):
            if not self._remaining:
                self._remaining = torch.randperm(self._count, generator=self._generator).tolist()
            batch.append(self._remaining.pop())
        return batch[self._rank]

    def peek(self) -> int | None:
        """Return what next() will return, or None if a new order has to be drawn first."""
        return self._remaining[-1 - self._rank] if self._rank < len(self._remaining) else None

    def state(self) -> tuple[Tensor, list[int]]:
        """Return the generator's state and the photos that remain of this order."""
        return self._generator.get_state(), list(self._remaining)

    def load_state(self, generator: Tensor, remaining: list) -> None:
        """Continue from state(); raises ValueError if it names photos that do not exist."""
        self._generator.set_state(generator.cpu())
        self._remaining = [operator.index(place) for place in remaining]
        if not all(0 <= place < self._count for place in self._remaining):
            raise ValueError(f"the order of the photos names others than the {self._count} there are")
