"""Replay renders that repeat as CUDA graphs: at the GPU's pace instead of Python's.

Rendering 2D Gaussians takes some ten launches; called from Python one by one, they take longer than a small image does.
After a few calls with the same sizes the next one is captured as CUDA graphs on memory of its own: inputs are copied
in, outputs are copied out.

This applies to calls of rasterize() and of gsplat's rasterization(). A training captures its whole step as one CUDA
graph (training/step_graphs.py); within it, and with max_intersections, calls are launched.
"""

import atexit
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .blending import BlendResult
from .captured_render import CapturedRender
from .cuda_graphs import is_capturing
from .projection import Gradients, ProjectedGaussians, with_projection_gradient
from .render_options import RenderOptions
from .tile_lists import MAX_SINGLE_SORT
from .warp_launch.launching import stream_handle

LOG = logging.getLogger(__name__)

WARMUP_CALLS = 4  # Launched calls of a size before one is captured: a capture takes the time of some twenty of them.
MAX_SIZES = 3  # Sizes of calls with CUDA graphs, the most recent ones.
MAX_GRAPHS = 4  # CUDA graphs of a size: each holds a render until its backward pass.
MAX_LARGE_GRAPHS = 1  # The same with more than MAX_SINGLE_SORT Gaussians, whose memory is hundreds of megabytes.
MAX_PIXELS = 1 << 21  # Larger images keep the GPU busy without CUDA graphs.
MAX_GAUSSIANS = 1 << 21


class _Signature(NamedTuple):
    """Properties that the calls of one CUDA graph share."""

    options: RenderOptions
    stream: int
    differentiable: bool
    tensors: tuple  # Shape, dtype and device of each.


def find_pool(tensors: Sequence[Any], options: RenderOptions) -> "GraphPool | None":
    """Return the CUDA graphs of calls like this one; None if there are none yet, or the call cannot be captured.

    tensors, options: as their user passed them. If calls like this one are known, they fit.
    """
    try:
        if not on_gpu(tensors[0]):
            return None
        signature = _signature(tensors, options)
        with _lock:
            pool = _pools.get(signature)
            if pool is not None:
                _pools.move_to_end(signature)
    except (AttributeError, TypeError, RuntimeError):
        return None
    return None if pool is None or is_capturing(tensors[0].device) else pool


def get_or_create_pool(tensors: Sequence[Tensor], options: RenderOptions) -> "GraphPool | None":
    """Return the CUDA graphs of calls like this one, an empty pool at first; None if the call cannot be captured.

    Args:
        tensors: as GraphPool.replay() takes them, of one device.
        options: of the image.
    """
    first = tensors[0]
    if not on_gpu(first) or first.dtype != torch.float32:
        return None
    if options.max_intersections is not None or options.deterministic:
        return None
    signature = _signature(tensors, options)
    fits = 0 < len(first) <= MAX_GAUSSIANS and options.width * options.height <= MAX_PIXELS
    if not fits or is_capturing(first.device):
        return None
    return _pool_of(signature, MAX_GRAPHS if len(first) <= MAX_SINGLE_SORT else MAX_LARGE_GRAPHS)


def on_gpu(tensor: Tensor) -> bool:
    """Return whether CUDA graphs can render it."""
    return tensor.is_cuda


def _signature(tensors: Sequence[Tensor], options: RenderOptions) -> _Signature:
    layouts, requires_grad = [], False
    for tensor in tensors:
        layouts += tensor.shape, tensor.dtype, tensor.device
        requires_grad = requires_grad or tensor.requires_grad
    differentiable = requires_grad and torch.is_grad_enabled()
    return _Signature(options, stream_handle(layouts[2]), differentiable, tuple(layouts))


class ReplayedRender:
    """A render by a CUDA graph, which no other call uses for as long as the backward passes of this render exist.

    They hold a lease of the graph. It ends when the autograd graph of the render is freed, or with this object for a
    render without gradients.

    Attributes:
        result: of the blend.
        intersections: of the render; 0 before fits().
    """

    def __init__(self, pool: "GraphPool", graph: "CapturedRender", result: Sequence[Tensor]) -> None:
        """Lease the CUDA graph."""
        self._pool, self._graph = pool, graph
        self._lease = _Lease(pool.idle, graph)
        image, transmittance, *self._others = result
        self.result = BlendResult(image, transmittance, self._lease.backward)
        self.intersections = 0

    def project(self, gaussians: tuple[Tensor, ...]) -> ProjectedGaussians | None:
        """Return the 2D Gaussians as differentiable functions of the seven tensors without the features.

        None if the CUDA graph began with them. Their conics and opacities are its memory.
        """
        if not self._others:
            return None
        means2d, depths, extents = self._others
        fixed = self._graph.splats.projected
        outputs = means2d, fixed.conics.detach(), depths, fixed.opacities.detach(), extents
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in gaussians):
            self._lease.differentiates_projection()
            outputs = with_projection_gradient(gaussians, outputs, self._lease.projection_adjoint)
        return ProjectedGaussians(*outputs)

    def fits(self) -> bool:
        """Wait until the GPU has counted the intersections; return whether the graph has memory for them.

        If not, the render is not to be used.
        """
        self.intersections = self._graph.count_intersections()
        if self.intersections <= self._graph.max_intersections:
            return True
        self._pool.grow(self.intersections)
        return False


@dataclass
class GraphPool:
    """The CUDA graphs of calls with one signature.

    Attributes:
        differentiable: whether the calls need backward passes.
        max_graphs: how many there may be.
        launched: calls that were launched.
        captured: CUDA graphs that were captured since the memory last grew.
        intersections: the least number that the next CUDA graph allocates memory for.
        idle: CUDA graphs that no call holds.
    """

    differentiable: bool = False
    max_graphs: int = MAX_GRAPHS
    launched: int = 0
    captured: int = 0
    intersections: int = 0
    idle: list[CapturedRender] = field(default_factory=list)

    def take(self, capture: Callable[[int], CapturedRender]) -> CapturedRender | None:
        """Return a CUDA graph that is the caller's until it is idle again; None for a call that is to be launched."""
        if self.idle:
            with suppress(IndexError):
                return self.idle.pop()
        self.launched += 1
        if self.launched <= WARMUP_CALLS or self.captured >= self.max_graphs:
            return None
        self.captured += 1
        try:
            return capture(self.intersections)
        except RuntimeError:
            LOG.debug("a render could not be captured and is launched", exc_info=True)
            self.captured = self.max_graphs
            return None

    def replay(
        self, tensors: Sequence[Tensor], options: RenderOptions, outputs: Sequence[Tensor] = ()
    ) -> ReplayedRender | None:
        """Render by a CUDA graph, or return None if the call is to be launched instead.

        Args:
            tensors: the seven tensors of a call, or flatten() of RasterInputs.
            options: of the image.
            outputs: for RasterInputs (extents,), to be written to.
        """

        def capture(intersections: int) -> CapturedRender:
            with torch.inference_mode(False), torch.no_grad():
                return CapturedRender(tensors, options, intersections, self.differentiable)

        with torch.no_grad():
            graph = self.take(capture)
            return None if graph is None else ReplayedRender(self, graph, graph.replay(tensors, outputs))

    def grow(self, intersections: int) -> None:
        """Let new CUDA graphs be captured, because one had too little memory for this many intersections."""
        self.intersections, self.captured, self.idle = max(intersections, self.intersections), 0, []


class _Lease:
    """Keeps a CUDA graph from other calls, and returns it to the idle ones when it is deleted."""

    def __init__(self, idle: list[CapturedRender], graph: CapturedRender) -> None:
        self._idle, self._graph = idle, graph
        self._zeros: list[Tensor] = []  # For the projection's gradients, from the blend's last backward pass.
        self._of_projection = False

    def differentiates_projection(self) -> None:
        """Let backward() allocate memory for projection_adjoint() too: one allocation, one launch that fills it."""
        self._of_projection = True

    def backward(self, grad_image: Tensor, grad_transmittance: Tensor | None) -> Tensor:
        graph, fixed = self._graph, self._graph.backward
        assert fixed is not None, "the CUDA graph is not differentiable"
        zeros = graph.zero_gradients(grad_image, of_projection=self._of_projection)
        if self._of_projection:
            self._zeros[:] = [zeros]
        return fixed.add_to(zeros, grad_image, grad_transmittance)

    def projection_adjoint(
        self, inputs: Sequence[Tensor], culling: Tensor, upstream: Gradients, needed: Sequence[bool]
    ) -> Gradients:
        graph = self._graph
        try:
            zeros = self._zeros.pop()
        except IndexError:  # The image has no gradient, only the 2D Gaussians.
            zeros = graph.zero_gradients(culling, of_projection=True)
        return graph.add_projection_gradients(zeros, upstream[:-1], needed)

    def __del__(self) -> None:
        self._idle.append(self._graph)


_lock = threading.Lock()
_pools: OrderedDict[_Signature, GraphPool] = OrderedDict()


def clear_graphs() -> None:
    """Free all CUDA graphs and their memory."""
    _pools.clear()


atexit.register(clear_graphs)  # CUDA graphs must be freed before CUDA is.


def _pool_of(signature: _Signature, max_graphs: int) -> GraphPool:
    with _lock:
        pool = _pools.setdefault(signature, GraphPool(signature.differentiable, max_graphs))
        _pools.move_to_end(signature)
        while len(_pools) > MAX_SIZES:
            _pools.popitem(last=False)
    return pool
