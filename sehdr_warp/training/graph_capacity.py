"""How much room for (Gaussian, tile) pairs recorded steps get: fixed when they are recorded, while photos differ."""

import math

import torch
from torch import Tensor

ROOM = 1.25  # Room in multiples of the most pairs seen: photos of a scene differ by up to 1.32 in theirs
KEPT = 0.97  # Of the room, at least, when Gaussians change: after a reset of opacities pairs are few for a while
LEAST_ROOM = 1 << 14


class GraphCapacity:
    """Counts pairs on the device and says how many the next recording gets room for."""

    def __init__(self, device: torch.device | str):
        self._needed, self._lacked = (torch.zeros((), dtype=torch.int64, device=device) for _ in range(2))
        self._pairs = self._given = 0

    @property
    def known(self) -> bool:
        """Whether any step was launched whose pairs were counted exactly."""
        return self._pairs > 0

    def launched(self, pairs: int) -> None:
        """A step was launched with exactly so many pairs."""
        self._pairs = max(self._pairs, pairs)

    def note(self, pairs: Tensor, overflow: Tensor) -> None:
        """Part of a recorded step: the pairs it would have needed, int64 [], and whether it lacked room, bool []."""
        torch.maximum(self._needed, pairs, out=self._needed)
        self._lacked += overflow

    @property
    def lacked(self) -> int:
        """Steps that lacked room so far. Waits for the device."""
        return int(self._lacked)

    def capacity(self) -> int:
        """The room for pairs of the step that is recorded or replayed now; stays until one of the calls below."""
        self._given = self._given or max(LEAST_ROOM, math.ceil(ROOM * self._pairs))
        return self._given

    def look(self) -> bool:
        """Whether steps since the last look lacked room; the next recording then has what they needed. Waits for the
        device."""
        needed = int(self._needed)
        if not 0 < self._given < needed:
            return False
        self._pairs, self._given = needed, 0
        return True

    def change(self, growth: float) -> None:
        """The Gaussians are others, `growth` times as many. Waits for the device."""
        needed = int(self._needed) or self._pairs
        # The kept part does not grow: new Gaussians are smaller, and pairs grow more slowly than their number.
        self._pairs = math.ceil(max(needed * growth, KEPT * self._pairs))
        self._needed.zero_()
        self._given = 0
