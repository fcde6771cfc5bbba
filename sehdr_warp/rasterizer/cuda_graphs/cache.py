"""Replay renders that repeat as CUDA graphs: at the GPU's pace instead of Python's.

Rendering 2D Gaussians takes some ten launches; called from Python one by one, they take longer than a small image does.
After a few calls with the same sizes the next one is captured as CUDA graphs on memory of its own, which copy inputs in
and results out.

This applies to calls of rasterize() and, with packed=False, of gsplat's rasterization(). A training captures its whole
step as one CUDA graph (training/step_runner.py); within it, and with max_intersections, calls are launched.

A call, from top to bottom: pool_for() returns the GraphPool of calls like it; begin_render() takes one of its graphs
(render_graph.py), and that GraphInUse renders. torch's backward pass then calls its
blend_backward() and project_backward() (captured_backward.py).
"""

import atexit
import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import torch
from torch import Tensor
from torch._C._dynamo.guards import TensorGuards

from ..blending import BlendResult
from ..projection import GaussiansAndCamera, Splats2D, with_projection_gradient
from ..render_options import RenderOptions
from ..tile_lists import MAX_SINGLE_SORT
from ..warp_launch.launching import stream_handle
from .captured_backward import GradientMemory
from .render_graph import RenderGraph
from .runner import is_capturing, replays_are_off

LOG = logging.getLogger(__name__)

WARMUP_CALLS = 4  # Launched calls of a pool before one is captured: a capture takes the time of some twenty of them.
MAX_POOLS = 3  # Pools of CUDA graphs, one for each CallPattern, the most recent ones.
MAX_GRAPHS = 4  # CUDA graphs of a pool: each holds a render until its backward pass.
MAX_LARGE_GRAPHS = 1  # The same with more than MAX_SINGLE_SORT Gaussians, whose memory is hundreds of megabytes.
MAX_PIXELS = 1 << 21  # Larger images keep the GPU busy without CUDA graphs.
MAX_GAUSSIANS = 1 << 21


def checked_pool(tensors: Sequence[Any], options: RenderOptions) -> "GraphPool | None":
    """Return pool_for() a call if there is one: a call like it was then checked, and this one need not be.

    tensors, options: as their user passed them, of any type.
    """
    try:
        pool = _known_pool(tensors, options)
    except (TypeError, RuntimeError):  # Arrays among the options, or another thread made a pool meanwhile.
        return None
    # 640.0 equals 640, and is refused where arguments are checked.
    if pool is None or type(options.width) is not int or type(options.height) is not int or replays_are_off():
        return None
    pool.last_use = next(_uses)
    return pool


def pool_for(tensors: Sequence[Tensor], options: RenderOptions) -> "GraphPool | None":
    """Return the CUDA graphs of calls like this one, an empty pool at first; None on the CPU and if none can be."""
    first = tensors[0]
    if not on_gpu(first) or first.dtype != torch.float32:
        return None
    if options.max_intersections is not None or options.deterministic or replays_are_off():
        return None
    fits = 0 < len(first) <= MAX_GAUSSIANS and options.width * options.height <= MAX_PIXELS
    if not fits or is_capturing(first.device):
        return None
    if len({*map(id, tensors)}) < len(tensors):  # TensorGuards tells nothing of a tensor that is passed twice.
        tensors = [tensor.view_as(tensor) for tensor in tensors]
    with _lock:
        pool = _known_pool(tensors, options)
        if pool is None:
            differentiable = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
            pool = GraphPool(differentiable, MAX_GRAPHS if len(first) <= MAX_SINGLE_SORT else MAX_LARGE_GRAPHS)
            pools[CallPattern(tensors, options)] = pool
        pool.last_use = next(_uses)
        while len(pools) > MAX_POOLS:
            del pools[min(pools, key=lambda pattern: pools[pattern].last_use)]
    return pool


def _known_pool(tensors: Sequence[Any], options: RenderOptions) -> "GraphPool | None":
    for pattern, pool in pools.items():
        if pattern.matches(tensors, options):
            return pool
    return None


class CallPattern:
    """Properties that all calls of a pool have: options, stream, grad mode, and each tensor's, but for its values."""

    def __init__(self, tensors: Sequence[Tensor], options: RenderOptions) -> None:
        """Note those of a call that can be captured."""
        self._device, self._options, self._count = tensors[0].device, options, len(tensors)
        self._hash = hash(options)
        self._grad_mode, self._stream = torch.is_grad_enabled(), stream_handle(tensors[0].device)
        # Compares type, shape, strides, dtype, device and requires_grad of all tensors in a quarter of Python's time.
        self._guards = TensorGuards(*tensors, dynamic_dims_sizes=None, dynamic_dims_strides=None)

    def matches(self, tensors: Sequence[Any], options: RenderOptions) -> bool:
        """Return whether a call has them."""
        return (
            hash(options) == self._hash  # Tensors of equal values are no options.
            and options == self._options
            and len(tensors) == self._count
            and self._guards.check(*tensors)
            and torch.is_grad_enabled() == self._grad_mode
            and stream_handle(self._device) == self._stream
        )


def on_gpu(tensor: Tensor) -> bool:
    """Return whether CUDA graphs can render it; tests without a GPU replace this function."""
    return tensor.is_cuda


class GraphInUse:
    """A CUDA graph that renders one call, and that no other call gets until this object is deleted.

    Autograd's nodes refer to this object, so it lives until the autograd graph of the render is freed. It does not
    refer to the tensors that the nodes return, which would keep it alive for ever.
    """

    def __init__(self, pool: "GraphPool", graph: RenderGraph) -> None:
        """Keep the CUDA graph from other calls."""
        self._pool, self._idle, self._graph = pool, pool.idle, graph
        self._prepared: GradientMemory | None = None  # For the next backward pass of the blend.
        self._blended: GradientMemory | None = None  # Of the last one, until that of the projection.

    def __del__(self) -> None:
        """Return the CUDA graph to the pool."""
        self._idle.append(self._graph)

    def render(self, tensors: GaussiansAndCamera) -> tuple[BlendResult, Tensor, Tensor, Tensor, Tensor | None]:
        """Project and render; return the image, and means2d, depths, extents, and CapturedBackward.conics_opacities.

        The image has no gradient, the others are functions of the tensors. The last one is None without gradients.
        """
        backward = self._graph.backward
        image, transmittance, (means2d, depths, extents), self._prepared = self._graph.replay(tensors)
        blended = BlendResult(image, transmittance, self.blend_backward)
        if backward is None:
            return blended, means2d, depths, extents, None
        assert backward.conics_opacities is not None, "the CUDA graph begins with 2D Gaussians"
        outputs = means2d, backward.conics_opacities.detach(), depths, extents
        outputs = with_projection_gradient(outputs, tensors.without_features, self.project_backward)
        means2d, conics_opacities, depths, extents = outputs
        return blended, means2d, depths, extents, conics_opacities

    def render_projected(self, splats: Splats2D) -> BlendResult:
        """Render; write the extents that are left, see pack_splats()."""
        image, transmittance, _, self._prepared = self._graph.replay(splats, (splats.extents,))
        return BlendResult(image, transmittance, self.blend_backward)

    def count_intersections(self) -> int | None:
        """Wait until the GPU has counted the intersections; return how many there are.

        None if the graph has too little memory for them: the render is not to be used.
        """
        intersections = self._graph.count_intersections()
        if intersections <= self._graph.max_intersections:
            return intersections
        self._pool.grow(intersections)
        return None

    def blend_backward(self, grad_image: Tensor, grad_transmittance: Tensor | None) -> Sequence[Tensor]:
        """Return the gradients with respect to what was blended, see CapturedBackward.blend()."""
        backward = self._graph.backward
        assert backward is not None
        memory, self._prepared = self._prepared or backward.allocate(), None
        self._blended = memory
        return backward.blend(memory, grad_image, grad_transmittance)

    def project_backward(
        self, inputs: Sequence[Tensor], visibility: Tensor, upstream: Sequence[Tensor | None], needed: Sequence[bool]
    ) -> Sequence[Tensor | None]:
        """Return the gradients with respect to the projection's inputs, see ProjectionBackward.

        upstream: of means2d, conics_opacities (GradientMemory.zeros, from blend_backward()), and depths.
        """
        grad_means2d, zeros, grad_depths, _ = upstream
        backward = self._graph.backward
        assert backward is not None
        memory, self._blended = self._blended, None
        # Autograd hands on the very tensor that blend_backward() returned, unless passes overlap or nothing reached the
        # image.
        if memory is None or memory.zeros is not zeros:
            memory = backward.allocate(zeros)
        return backward.project(memory, grad_means2d, grad_depths)


@dataclass
class GraphPool:
    """The CUDA graphs of calls with one CallPattern."""

    differentiable: bool = False  # Whether the calls need backward passes
    max_graphs: int = MAX_GRAPHS
    launched: int = 0  # Calls that were launched
    captured: int = 0  # CUDA graphs that were captured since the memory last grew
    intersections: int = 0  # The least number that the next CUDA graph allocates memory for
    idle: list[RenderGraph] = field(default_factory=list)  # CUDA graphs that no call holds
    last_use: int = 0  # Number of the last call

    def begin_render(self, tensors: GaussiansAndCamera | Splats2D, options: RenderOptions) -> GraphInUse | None:
        """Return a CUDA graph for one render, from Splats2D if they are projected already.

        None if the call is to be launched instead.
        """
        try:
            graph = self.idle.pop()
        except IndexError:
            graph = self._capture(tensors, options)
        return None if graph is None else GraphInUse(self, graph)

    def _capture(self, tensors: GaussiansAndCamera | Splats2D, options: RenderOptions) -> RenderGraph | None:
        self.launched += 1
        if self.launched <= WARMUP_CALLS or self.captured >= self.max_graphs:
            return None
        self.captured += 1
        try:
            with torch.inference_mode(False), torch.no_grad():
                return RenderGraph(tensors, options, self.intersections, self.differentiable)
        except RuntimeError:
            LOG.debug("a render could not be captured and is launched", exc_info=True)
            self.captured = self.max_graphs
            return None

    def grow(self, intersections: int) -> None:
        """Let new CUDA graphs be captured, because one had too little memory for this many intersections."""
        self.intersections, self.captured, self.idle = max(intersections, self.intersections), 0, []


_lock = threading.Lock()
pools: dict[CallPattern, GraphPool] = {}
"""The CUDA graphs of all calls."""
_uses = count(1)


def clear_graphs() -> None:
    """Free all CUDA graphs and their memory."""
    pools.clear()


atexit.register(clear_graphs)  # CUDA graphs must be freed before CUDA is.
