"""How much room for (Gaussian, tile) pairs recorded steps get: fixed when they are recorded, while photos differ."""

import math

import torch

ROOM = 1.25  # Room in multiples of the most pairs seen: photos of a scene differ by up to 1.32 in theirs
ENOUGH = 1.08  # Of the pairs that are expected of changed Gaussians: with less room steps are recorded anew
KEPT = 0.97  # Of the room, at least, when Gaussians change: after a reset of opacities pairs are few for a while
LEAST_ROOM = 1 << 14


class GraphCapacity:
    """Says how many pairs the next recording gets room for, from what steps count on the device.

    tally: [3] int64, of all steps so far: how many were not finite; the most pairs that one needed, 0 again when
    Gaussians change; how many lacked room. training_step.judge_step() counts.
    """

    def __init__(self, device: torch.device | str):
        self.tally = torch.zeros(3, dtype=torch.int64, device=device)
        self._pairs = self._given = self._noted = 0
        self._seen, self._copied = self.tally, None
        if self.tally.device.type == "cuda":
            self._seen = torch.zeros(3, dtype=torch.int64, pin_memory=True)
            self._copied = torch.cuda.Event()

    @property
    def known(self) -> bool:
        """Whether any step was launched whose pairs were counted exactly."""
        return self._pairs > 0

    def launched(self, pairs: int) -> None:
        """A step was launched with exactly so many pairs."""
        self._pairs = max(self._pairs, pairs)

    @property
    def lacked(self) -> int:
        """Steps that lacked room so far. Waits for the device."""
        return int(self.tally[2])

    def capacity(self) -> int:
        """The room for pairs of the step that is recorded or replayed now; stays until one of the calls below."""
        self._given = self._given or max(LEAST_ROOM, math.ceil(ROOM * self._pairs))
        return self._given

    def look(self, *, wait: bool = True) -> tuple[int, bool]:
        """Steps that were not finite, and whether the room was too little: the next recording then has what steps
        needed. wait: False asks a GPU what it had counted at the last such look, and does not wait for it."""
        if wait or self._copied is None:
            skipped, needed, _ = self.tally.tolist()
        else:
            self._copied.synchronize()
            skipped, needed, _ = self._seen.tolist()
            self._seen.copy_(self.tally, non_blocking=True)
            self._copied.record(torch.cuda.current_stream(self.tally.device))
        self._noted = needed
        if not 0 < self._given < needed:
            return skipped, False
        self._pairs, self._given = needed, 0
        return skipped, True

    def change(self, growth: float, *, keep: bool) -> bool:
        """The Gaussians are others, `growth` times as many: whether the room stays as it is, which it does where
        `keep` asks for that and it is enough."""
        needed = self._noted or int(self.tally[1]) or self._pairs
        # The kept part does not grow: new Gaussians are smaller, and pairs grow more slowly than their number.
        self._pairs = math.ceil(max(needed * growth, KEPT * self._pairs))
        self.tally[1].zero_()
        self._noted = 0
        if keep and self._given >= ENOUGH * self._pairs:
            return True
        self._given = 0
        return False
