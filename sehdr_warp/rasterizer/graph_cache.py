"""Replay renders that repeat as CUDA graphs: at the GPU's pace instead of Python's.

Rendering 2D Gaussians takes some ten launches; called from Python one by one, they take longer than a small image does.
After a few calls with the same sizes the next one is captured as CUDA graphs on memory of its own: inputs are copied
in, outputs are copied out.
"""

import atexit
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from .blending import Adjoint, BlendResult, blend_on_cuda
from .cuda_graphs import CudaGraphRunner, is_capturing
from .tile_lists import (
    MAX_INTERSECTIONS,
    ONE_SORT,
    IntersectionOffsets,
    PackedSplats,
    Splats,
    build_tile_lists,
    order_intersections,
    pack_splats,
)
from .warp_launch.launching import stream_handle

LOG = logging.getLogger(__name__)

WARMUP_CALLS = 4  # Launched calls of a size before one is captured: a capture takes the time of some twenty of them.
MAX_SIZES = 3  # Sizes of calls with graphs, the most recent ones.
MAX_GRAPHS = 4  # Graphs of a size: each holds a render until its backward pass.
MAX_PIXELS = 1 << 21  # Larger images keep the GPU busy without graphs.
MAX_GAUSSIANS = 1 << 21  # Without a backward pass; with one the host is the bottleneck only up to ONE_SORT.
HEADROOM = 1.25  # Memory for intersections, as a multiple of those of the captured call.
MIN_INTERSECTIONS = 1 << 12


class ImageSize(NamedTuple):
    """Size of an image in pixels, and the alpha below which a contribution is left out."""

    width: int
    height: int
    alpha_threshold: float


class GraphRender(NamedTuple):
    """A render by a CUDA graph, and its number of (Gaussian, tile) intersections."""

    result: BlendResult
    intersections: int


@torch.no_grad()
def render_from_graph(splats: Splats, size: ImageSize, differentiable: bool) -> GraphRender | None:
    """Render by a CUDA graph, or return None if the call is to be launched instead.

    Sets splats.extents to 0 in place for Gaussians whose features are not finite.

    Args:
        splats: the 2D Gaussians, float32.
        size: of the image.
        differentiable: whether the adjoint may be called.
    """
    features, device = splats.features, splats.features.device
    if device.type != "cuda" or features.dtype != torch.float32:
        return None
    small = 0 < len(features) <= (ONE_SORT if differentiable else MAX_GAUSSIANS)
    if not small or size.width * size.height > MAX_PIXELS or is_capturing(device):
        return None
    graphs = _graphs_of((device, stream_handle(device), *features.shape, size, differentiable))
    graph = graphs.take(lambda intersections: _RenderGraph(splats, size, intersections))
    if graph is None:
        return None
    image, transmittance, intersections = graph.replay(splats)
    if intersections > graph.max_intersections:
        graphs.grow(intersections)
        return None
    if not differentiable:
        graphs.idle.append(graph)
        return GraphRender(BlendResult(image, transmittance, graph.adjoint), intersections)
    lease = _Lease(graphs.idle, graph)
    return GraphRender(BlendResult(image, transmittance, lease.adjoint), intersections)


class _RenderGraph:
    """One render on fixed memory, in two graphs, between which the number of intersections is copied to the host.

    intersections: the least number to allocate memory for.
    """

    def __init__(self, splats: Splats, size: ImageSize, intersections: int) -> None:
        width, height, threshold = size
        self._splats = Splats(*(tensor.detach().clone() for tensor in splats))
        features, depths, extents = self._splats.features, self._splats.depths, self._splats.extents
        self._image = features.new_empty(height, width, features.shape[1])
        self._transmittance = features.new_empty(height, width)
        self._intersections = torch.empty(1, dtype=torch.int64, pin_memory=True)
        self._counted, self._stream = torch.cuda.Event(), torch.cuda.current_stream(features.device)
        self._counting = CudaGraphRunner(features.device)
        self._blending = CudaGraphRunner(features.device, self._counting.stream)

        def count() -> tuple[PackedSplats, IntersectionOffsets]:
            packed = pack_splats(self._splats, threshold, width, height)
            offsets = order_intersections(packed.counts, depths, extents, unsorted=False)
            self._intersections.copy_(offsets.ends[-1:], non_blocking=True)
            return packed, offsets

        def blend(packed: PackedSplats, offsets: IntersectionOffsets, limit: int) -> Adjoint:
            lists = build_tile_lists(packed, offsets, depths, extents, width, height, limit, unsorted=False)
            return blend_on_cuda(features, lists, packed, self._image, self._transmittance, threshold, False)

        # Launched once: nothing may be compiled or loaded during a capture, and it tells how much memory is needed.
        with self._counting.on_capture_stream():
            packed, offsets = count()
            limit = int(HEADROOM * max(intersections, int(offsets.ends[-1])))
            self.max_intersections = min(max(MIN_INTERSECTIONS, limit), MAX_INTERSECTIONS)
            blend(packed, offsets, self.max_intersections)
            del packed, offsets
        packed, offsets = self._counting.capture(None, count)
        self.adjoint: Adjoint = self._blending.capture(None, lambda: blend(packed, offsets, self.max_intersections))
        """Confidence of the last render; one launch, which needs no graph."""

    def replay(self, splats: Splats) -> tuple[Tensor, Tensor, int]:
        """Return image, transmittance and the number of intersections; those beyond max_intersections are left out."""
        torch._foreach_copy_(list(self._splats), list(splats))  # pyright: ignore[reportPrivateImportUsage]
        self._counting.replay()
        self._counted.record(self._stream)
        self._blending.replay()
        outputs = [self._image, self._transmittance, self._splats.extents]
        image, transmittance = torch.empty_like(self._image), torch.empty_like(self._transmittance)
        torch._foreach_copy_([image, transmittance, splats.extents], outputs)  # pyright: ignore[reportPrivateImportUsage]
        self._counted.synchronize()
        return image, transmittance, int(self._intersections)


@dataclass
class _SizeGraphs:
    """The graphs of calls of one size.

    Attributes:
        launched: calls that were launched.
        captured: graphs that were captured since the memory last grew.
        intersections: the least number that the next graph allocates memory for.
        idle: graphs that no call holds.
    """

    launched: int = 0
    captured: int = 0
    intersections: int = 0
    idle: list[_RenderGraph] = field(default_factory=list)

    def take(self, capture: Callable[[int], _RenderGraph]) -> _RenderGraph | None:
        """Return a graph that is the caller's until it is idle again; None for a call that is to be launched."""
        with suppress(IndexError):
            return self.idle.pop()
        self.launched += 1
        if self.launched <= WARMUP_CALLS or self.captured >= MAX_GRAPHS:
            return None
        self.captured += 1
        try:
            return capture(self.intersections)
        except RuntimeError:
            LOG.debug("a render could not be captured and is launched", exc_info=True)
            self.captured = MAX_GRAPHS
            return None

    def grow(self, intersections: int) -> None:
        """Let new graphs be captured, because one had too little memory for this many intersections."""
        self.intersections, self.captured, self.idle = max(intersections, self.intersections), 0, []


class _Lease:
    """Keeps a graph from other calls for as long as it lives."""

    def __init__(self, idle: list[_RenderGraph], graph: _RenderGraph) -> None:
        self._idle, self._graph = idle, graph

    def adjoint(self, by_image: Tensor, by_transmittance: Tensor | None) -> Tensor:
        return self._graph.adjoint(by_image, by_transmittance)

    def __del__(self) -> None:
        self._idle.append(self._graph)


_lock = threading.Lock()
_graphs: OrderedDict[tuple, _SizeGraphs] = OrderedDict()


def clear_graphs() -> None:
    """Free all graphs and their memory."""
    _graphs.clear()


atexit.register(clear_graphs)  # Graphs must be freed before CUDA is.


def _graphs_of(key: tuple) -> _SizeGraphs:
    with _lock:
        graphs = _graphs.setdefault(key, _SizeGraphs())
        _graphs.move_to_end(key)
        while len(_graphs) > MAX_SIZES:
            _graphs.popitem(last=False)
    return graphs
