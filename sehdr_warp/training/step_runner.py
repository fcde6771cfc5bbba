"""Gradient steps as CUDA graphs.

A graph replays the kernels of GradientStep.run(); none of its Python code runs.
It fixes the size of its memory when it is captured, while photos differ in their number of Gaussian-tile
intersections: GraphCapacity counts them and chooses how many a captured step has memory for.
"""

import math
from contextlib import AbstractContextManager, nullcontext
from typing import TypeGuard

import torch
from torch import Tensor

from ..errors import SehdrError
from ..rasterizer import CudaGraphRunner
from ..rasterizer.memory import failed_allocation
from .data_manager import DeviceViews, PhotoStream
from .gradient_step import MOST_INTERSECTIONS, GradientStep, GraphKey, StepOptions, StepResult
from .training_views import ViewStack

HEADROOM = 1.25  # Capacity as a multiple of the largest count; the photos of a scene differ by a factor of up to 1.32
MIN_HEADROOM = 1.08  # After densification, a capacity below this multiple of the expected count is replaced
MIN_SHRINK = 0.97  # Smallest factor of the count after densification: a reset of opacities lowers it only for a while
MIN_CAPACITY = 1 << 14
MAX_RESERVE = 1.5  # Largest number of reserved rows as a multiple of the count; they cost memory and a little time


class StepRunner:
    """Runs gradient steps: as CUDA graphs if that is possible, else by GradientStep.run(), as on a CPU.

    On one GPU, a step is one graph. On several, it is two, and gradients are averaged between.

    Attributes:
        enabled: Whether steps are captured.
        reserves_rows: Whether steps run on reserved rows, so that the number of Gaussians can change without a new
            capture. Sums over more rows have other last bits.
    """

    def __init__(self, step: GradientStep, *, enabled: bool, deterministic: bool):
        """Create the graph runners of a training's steps; they are disabled on a CPU."""
        self._step, self._capacity = step, GraphCapacity(step.step_counters)
        device = step.step_counters.device
        self.enabled = enabled and device.type == "cuda"
        self.reserves_rows, self._reserved_rows = self.enabled and not deterministic, 0
        # Of the whole step; on several GPUs of what precedes the average of the gradients, and of the update after it.
        self._graph = CudaGraphRunner(device) if self.enabled else None
        self._update_graph = CudaGraphRunner(device, self._graph.stream) if self._graph and step.ranks else None
        self._index = torch.zeros(1, dtype=torch.int64, device=device)
        self._eager_keys: set[GraphKey] = set()

    def run(
        self, views: DeviceViews, index: int, next_index: int | None, options: StepOptions, iteration: int
    ) -> StepResult:
        """Do GradientStep.run() on view `index`; if photos are streamed, fetch view `next_index` at the same time."""
        step, gaussians = self._step, self._step.field.gaussians
        # Gaussians.surround() adds rows of its own, which are rendered but not trained: none are reserved then.
        if self.reserves_rows and not self._reserved_rows and gaussians.row_count == gaussians.count:
            self._reserve_rows(iteration)
        step.prepare(options, iteration)
        key = step.graph_key(views, options)
        if self.can_replay(views, key) and (capacity := self._capacity.for_next_step()) is not None:
            return self._replay(views, index, next_index, options, key, capacity, iteration)
        with self.on_capture_stream():  # Without a capacity, so that result.intersections is their number.
            result = step.run(views[index], options)
        self._capacity.record(result.intersections)
        if key is not None:
            self._eager_keys.add(key)
        return result

    def can_replay(self, views: DeviceViews, key: GraphKey | None) -> TypeGuard[ViewStack | PhotoStream]:
        """Return whether a step can be captured: an index on the device selects its photo, and its kernels are loaded.

        Kernels are loaded when they first run, so the first step of a key runs without a graph.
        """
        return self._graph is not None and isinstance(views, ViewStack | PhotoStream) and key in self._eager_keys

    def on_capture_stream(self) -> AbstractContextManager[None]:
        """Return a context for other work, which shares stream and memory with captured steps."""
        return nullcontext() if self._graph is None else self._graph.on_capture_stream()

    def _replay(
        self,
        views: ViewStack | PhotoStream,
        index: int,
        next_index: int | None,
        options: StepOptions,
        key: GraphKey | None,
        capacity: int,
        iteration: int,
    ) -> StepResult:
        """Replay the graphs of a key; they are captured if there are none."""
        step, graph, update_graph = self._step, self._graph, self._update_graph
        assert graph is not None
        self._index.fill_(index)
        if isinstance(views, PhotoStream):
            views.stage(index)
        try:
            if update_graph is None:
                result = graph.run(key, lambda: step.run(views.at(self._index), options, capacity))
            else:
                with step.reserved_memory():
                    gradients = graph.run(key, lambda: step.compute_gradients(views.at(self._index), options, capacity))
                    step.average_gradients()
                    loss = update_graph.run(key, lambda: step.apply_gradients(gradients))
                result = StepResult(loss, gradients.image, gradients.rendering.intersection_count)
        except RuntimeError as error:
            if failed_allocation(error):
                raise
            # The device's state after a failed capture is undefined, so the training cannot go on.
            raise SehdrError(
                f"iteration {iteration}: the step could not be captured as a CUDA graph "
                f"({str(error).splitlines()[0]}); train with --schedule.use-cuda-graph=false, which is slower"
            ) from error
        if isinstance(views, PhotoStream):
            views.release(next_index)
        return result

    def after_densification(self, count: int, reallocations: int, iteration: int) -> None:
        """Adapt rows, capacity and graphs after Gaussians were added or removed.

        `count` and `reallocations` are those of the Gaussians before.
        """
        gaussians = self._step.field.gaussians
        if self.reserves_rows:
            self._reserve_rows(iteration)
        if self.enabled:
            same_memory = gaussians.reallocations == reallocations
            if not self._capacity.rescale(gaussians.count / max(1, count), same_memory=same_memory):
                self.invalidate()

    def _reserve_rows(self, iteration: int) -> None:
        """Reserve rows for the Gaussians that refinements will add; the same number on all ranks."""
        gaussians, count = self._step.field.gaussians, self._step.field.gaussians.count
        rows = self._step.strategy.reserved_rows(iteration, count)
        if rows == count or not count <= self._reserved_rows <= MAX_RESERVE * count:
            self._reserved_rows = rows
        if gaussians.row_count != self._reserved_rows:
            gaussians.reserve(self._reserved_rows, self._step.optimizer)

    def poll(self, *, wait: bool) -> int:
        """Return the number of steps that were not finite, as GraphCapacity.poll(); free graphs that were too small."""
        not_finite, overflowed = self._capacity.poll(wait=wait)
        if overflowed:  # Those steps applied no gradients; the next capture has the capacity that they needed.
            self.invalidate()
        return not_finite

    def invalidate(self) -> None:
        """Free the graphs, because something that they hold fixed has changed."""
        for runner in (self._graph, self._update_graph):
            if runner is not None:
                runner.invalidate()


class GraphCapacity:
    """Chooses the intersection capacity of the next capture from counts that steps keep on the device."""

    def __init__(self, step_counters: Tensor):
        """Start without counts; step_counters as in GradientStep."""
        self.step_counters = step_counters
        self._expected = 0  # Upper bound of the intersections of the next photos; 0 before the first step
        self._counted = 0  # Largest number that poll() has read since the last rescale()
        self._capacity = 0  # Of the captured graphs; 0 if the next step is captured anew
        self._host_counters, self._copied = self.step_counters, None
        if self.step_counters.device.type == "cuda":
            self._host_counters = torch.zeros(3, dtype=torch.int64, pin_memory=True)
            self._copied = torch.cuda.Event()

    def record(self, intersections: int) -> None:
        """Record the exact number of intersections of a step that ran without a graph."""
        self._expected = max(self._expected, intersections)

    def for_next_step(self) -> int | None:
        """Return the capacity of the next step, the same until poll() or rescale() asks for another; None if unknown.

        It is unknown before the first record().
        """
        if self._expected:
            self._capacity = self._capacity or max(MIN_CAPACITY, math.ceil(HEADROOM * self._expected))
        return self._capacity or None

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
        self._counted = needed
        if not 0 < self._capacity < needed:
            return skipped, False
        self._expected, self._capacity = needed, 0
        return skipped, True

    def rescale(self, growth: float, *, same_memory: bool) -> bool:
        """Expect `growth` times as many intersections, because densification changed the Gaussians' number by it.

        Returns whether the captured graphs can be kept: if the Gaussians stayed in the same memory, and the capacity is
        at least MIN_HEADROOM times the expected number.
        """
        needed = self._counted or int(self.step_counters[MOST_INTERSECTIONS]) or self._expected
        # The lower bound does not grow: new Gaussians are small, so intersections grow more slowly than the count.
        self._expected = math.ceil(max(needed * growth, MIN_SHRINK * self._expected))
        self.step_counters[MOST_INTERSECTIONS].zero_()
        self._counted = 0
        if same_memory and self._capacity >= MIN_HEADROOM * self._expected:
            return True
        self._capacity = 0
        return False
