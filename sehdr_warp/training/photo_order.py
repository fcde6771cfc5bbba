"""Which photo is next: every photo once in random order, then again in another."""

import operator

import torch
from torch import Tensor


class PhotoOrder:
    """The order of `count` photos for several processes that train together, all of which draw it alike.

    rank, ranks: the number of this process, and how many there are.
    """

    def __init__(self, count: int, seed: int, rank: int = 0, ranks: int = 1):
        self._count, self._rank, self._ranks = count, rank, ranks
        self._left: list[int] = []
        self._generator = torch.Generator().manual_seed(seed)

    def next(self) -> int:
        """This process's photo, where each takes one."""
        chosen = []
        for _ in range(self._ranks):
            if not self._left:
                self._left = torch.randperm(self._count, generator=self._generator).tolist()
            chosen.append(self._left.pop())
        return chosen[self._rank]

    def following(self) -> int | None:
        """What next() will say; None where the order is not drawn yet."""
        return self._left[-1 - self._rank] if self._rank < len(self._left) else None

    def state(self) -> tuple[Tensor, list[int]]:
        """The generator's state and the photos that are left."""
        return self._generator.get_state(), list(self._left)

    def load_state(self, generator: Tensor, left: list) -> None:
        """Takes up what state() gave. Raises ValueError where it names photos that there are not."""
        self._generator.set_state(generator.cpu())
        self._left = [operator.index(place) for place in left]
        if not all(0 <= place < self._count for place in self._left):
            raise ValueError(f"the order of the photos names others than the {self._count} there are")
