"""CUDA graphs around the two functions of a training step, compute_gradients and apply_gradients.

A graph fixes the size of its memory when it is captured, while photos differ in their number of Gaussian-tile
intersections: GraphCapacity counts them and chooses how many a captured step has memory for.
"""

import math
from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeGuard, TypeVar

import torch

from ..errors import SehdrError
from ..rasterizer import CudaGraphRunner
from ..rasterizer.memory import failed_allocation
from .targets import ViewStack
from .training_views import PhotoStream

HEADROOM = 1.25  # Capacity as a multiple of the largest count; the photos of a scene differ by a factor of up to 1.32
MIN_HEADROOM = 1.08  # After densification, a capacity below this multiple of the expected count is replaced
MIN_SHRINK = 0.97  # Smallest factor of the count after densification: a reset of opacities lowers it only for a while
MIN_CAPACITY = 1 << 14

G = TypeVar("G")
Compute = Callable[[], G]
Apply = Callable[[G], torch.Tensor]


class StepGraphs:
    """Captures training steps as CUDA graphs and replays them; on a CPU, or disabled, it does nothing.

    On one GPU, both functions of a step are one graph. On several, they are two, and gradients are averaged between.

    Attributes:
        enabled: Whether steps are captured.
    """

    def __init__(self, device: torch.device, *, enabled: bool, several_ranks: bool):
        """Create the graph runners of a device."""
        self.enabled = enabled and device.type == "cuda"
        self._first = CudaGraphRunner(device) if self.enabled else None
        self._second = CudaGraphRunner(device, self._first.stream) if self._first and several_ranks else None
        self._launched: set[Hashable] = set()

    @property
    def captured(self) -> Any:
        """The CUDA graph that the next step with the same key replays; None if there is none."""
        return None if self._first is None else self._first._graph

    def is_ready(self, views: Any, graph_key: Hashable) -> TypeGuard[ViewStack | PhotoStream]:
        """Return whether a step can be captured: photos of one size, after a step with this key was launched.

        Args:
            views: The training views, which a captured step selects by an index on the device.
            graph_key: As by GradientStep.graph_key; None, which is never launched, if the step cannot be captured.
        """
        return self._first is not None and isinstance(views, ViewStack | PhotoStream) and graph_key in self._launched

    def mark_launched(self, graph_key: Hashable) -> None:
        """Note that a step with this key has been launched kernel by kernel, so that the next one can be captured."""
        self._launched.add(graph_key)

    def on_capture_stream(self) -> AbstractContextManager[None]:
        """Return a context for launched work, which shares stream and memory with captured steps."""
        return nullcontext() if self._first is None else self._first.on_capture_stream()

    def run(
        self,
        graph_key: Hashable,
        run_step: Callable[[Compute, Apply], Any],
        compute_gradients: Compute,
        apply_gradients: Apply,
        iteration: int,
    ) -> Any:
        """Replay run_step(compute_gradients, apply_gradients), after capturing it if this key has no graph.

        `run_step` is GradientStep.compute_and_apply: it averages the gradients of the ranks between the two.
        """
        first, second = self._first, self._second
        assert first is not None
        try:
            if second is None:
                return first.run(graph_key, lambda: run_step(compute_gradients, apply_gradients))
            return run_step(
                lambda: first.run(graph_key, compute_gradients),
                lambda gradients: second.run(graph_key, lambda: apply_gradients(gradients)),
            )
        except RuntimeError as error:
            if failed_allocation(error):
                raise
            # The device's state after a failed capture is undefined, so the training cannot go on.
            raise SehdrError(
                f"iteration {iteration}: the step could not be captured as a CUDA graph "
                f"({str(error).splitlines()[0]}); train with --schedule.use-cuda-graph=false, which is slower"
            ) from error

    def invalidate(self) -> None:
        """Free the graphs, because something that they hold fixed has changed."""
        for runner in (self._first, self._second):
            if runner is not None:
                runner.invalidate()


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

    def rescale(self, growth: float, *, same_memory: bool) -> bool:
        """Adapt the capacity after densification changed the count by the factor `growth`.

        Args:
            growth: New count over the old.
            same_memory: Whether the Gaussians stayed in the same memory, so that captured graphs are still valid.

        Returns:
            True if the current capacity, and with it the captured graphs, can be kept.
        """
        needed = self._largest or int(self.step_counters[1]) or self._intersections
        # The lower bound does not grow: new Gaussians are small, so intersections grow more slowly than the count.
        self._intersections = math.ceil(max(needed * growth, MIN_SHRINK * self._intersections))
        self.step_counters[1].zero_()
        self._largest = 0
        if same_memory and self._capacity >= MIN_HEADROOM * self._intersections:
            return True
        self._capacity = 0
        return False
