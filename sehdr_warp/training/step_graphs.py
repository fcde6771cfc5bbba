"""CUDA graphs around the two functions of a training step, compute_gradients and apply_gradients."""

from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeGuard, TypeVar

import torch

from ..errors import SehdrError
from ..rasterizer import CudaGraphRunner
from ..rasterizer.memory import failed_allocation
from .photo_stream import PhotoStream
from .targets import ViewStack

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

    def can_capture(self, views: Any, graph_key: Hashable, *, has_counts: bool) -> TypeGuard[ViewStack | PhotoStream]:
        """Return whether a step can be captured: photos of one size, after a step with this key was launched.

        Args:
            views: The training views, which a captured step selects by an index on the device.
            graph_key: Everything that changes which kernels a step launches; steps of one key share a graph.
            has_counts: Whether the number of intersections of a step is known.
        """
        if self._first is None or not isinstance(views, ViewStack | PhotoStream):
            return False
        ready = graph_key in self._launched and has_counts
        self._launched.add(graph_key)
        return ready

    def on_capture_stream(self) -> AbstractContextManager[None]:
        """Return a context for launched work, which shares stream and memory with captured steps."""
        return nullcontext() if self._first is None else self._first.on_capture_stream()

    def run(
        self,
        graph_key: Hashable,
        optimize: Callable[[Compute, Apply], Any],
        compute_gradients: Compute,
        apply_gradients: Apply,
        iteration: int,
    ) -> Any:
        """Replay optimize(compute_gradients, apply_gradients), after capturing it if this key has no graph."""
        first, second = self._first, self._second
        assert first is not None
        try:
            if second is None:
                return first.run(graph_key, lambda: optimize(compute_gradients, apply_gradients))
            return optimize(
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
