"""Count the Gaussian-tile intersections that a captured training step has memory for.

A CUDA graph fixes the size of its memory when it is captured, while photos differ in their number of intersections.
"""

import math

import torch

HEADROOM = 1.25  # Capacity as a multiple of the largest count; the photos of a scene differ by a factor of up to 1.32
MIN_HEADROOM = 1.08  # After densification, a capacity below this multiple of the expected count is replaced
MIN_SHRINK = 0.97  # Smallest factor of the count after densification: a reset of opacities lowers it only for a while
MIN_CAPACITY = 1 << 14


class GraphCapacity:
    """Chooses the intersection capacity of the next capture from counts that steps keep on the device.

    Attributes:
        step_counters: [3] int64, added up by training_step.check_finite(): steps that were not finite; largest number
            of intersections, set to 0 by rescale(); steps with more intersections than the capacity.
    """

    def __init__(self, device: torch.device | str):
        """Start without counts."""
        self.step_counters = torch.zeros(3, dtype=torch.int64, device=device)
        self._intersections = self._capacity = self._largest = 0
        self._host_counters, self._copied = self.step_counters, None
        if self.step_counters.device.type == "cuda":
            self._host_counters = torch.zeros(3, dtype=torch.int64, pin_memory=True)
            self._copied = torch.cuda.Event()

    @property
    def has_counts(self) -> bool:
        """True if observe() has recorded a step."""
        return self._intersections > 0

    def observe(self, intersections: int) -> None:
        """Record the exact number of intersections of a step."""
        self._intersections = max(self._intersections, intersections)

    @property
    def overflows(self) -> int:
        """Number of steps with more intersections than the capacity. Waits for the device."""
        return int(self.step_counters[2])

    def capacity(self) -> int:
        """Return the capacity for the step that is captured or replayed now; it stays until poll() or rescale()."""
        self._capacity = self._capacity or max(MIN_CAPACITY, math.ceil(HEADROOM * self._intersections))
        return self._capacity

    def poll(self, *, wait: bool = True) -> tuple[int, bool]:
        """Read the counts, and raise the capacity of the next capture if it was too small.

        Args:
            wait: If False, a GPU returns what it had counted at the previous call, and is not waited for.

        Returns:
            The number of steps that were not finite, and whether the capacity was too small.
        """
        if wait or self._copied is None:
            skipped, needed, _ = self.step_counters.tolist()
        else:
            self._copied.synchronize()
            skipped, needed, _ = self._host_counters.tolist()
            self._host_counters.copy_(self.step_counters, non_blocking=True)
            self._copied.record(torch.cuda.current_stream(self.step_counters.device))
        self._largest = needed
        if not 0 < self._capacity < needed:
            return skipped, False
        self._intersections, self._capacity = needed, 0
        return skipped, True

    def rescale(self, growth: float, *, keep: bool) -> bool:
        """Adapt the capacity after densification changed the count by the factor `growth`.

        Args:
            growth: New count divided by the old one.
            keep: Keep the current capacity if it suffices.

        Returns:
            True if the current capacity, and with it the captured graphs, can be kept.
        """
        needed = self._largest or int(self.step_counters[1]) or self._intersections
        # The lower bound does not grow: new Gaussians are small, so intersections grow more slowly than the count.
        self._intersections = math.ceil(max(needed * growth, MIN_SHRINK * self._intersections))
        self.step_counters[1].zero_()
        self._largest = 0
        if keep and self._capacity >= MIN_HEADROOM * self._intersections:
            return True
        self._capacity = 0
        return False
