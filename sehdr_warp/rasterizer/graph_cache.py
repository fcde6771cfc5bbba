"""Replay renders that repeat as CUDA graphs: at the GPU's pace instead of Python's.

Rendering 2D Gaussians takes some ten launches; called from Python one by one, they take longer than a small image does.
After a few calls with the same sizes the next one is captured as CUDA graphs on memory of its own: inputs are copied
in, outputs are copied out.
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
from .cuda_graphs import is_capturing
from .render_graph import FEATURES, AdjointGraph, RenderGraph
from .render_options import RenderOptions
from .tile_lists import ONE_SORT, Splats
from .torch_contract import direct_apply, keeps_graph, once_differentiable
from .warp_launch.launching import stream_handle

LOG = logging.getLogger(__name__)

WARMUP_CALLS = 4  # Launched calls of a size before one is captured: a capture takes the time of some twenty of them.
MAX_SIZES = 3  # Sizes of calls with graphs, the most recent ones.
MAX_GRAPHS = 4  # Graphs of a size: each holds a render until its backward pass.
MAX_PIXELS = 1 << 21  # Larger images keep the GPU busy without graphs.
MAX_GAUSSIANS = 1 << 21  # Without a backward pass.
MAX_DIFFERENTIABLE = ONE_SORT  # Gaussians with one, whose graphs hold four times as much.
MAX_SHARE = 1 / 16
"""Largest share of a GPU's memory for one graph: what it holds is not there for others between calls."""


class _Signature(NamedTuple):
    """Properties that the calls of one graph share."""

    options: RenderOptions
    stream: int
    differentiable: bool
    tensors: tuple  # Shape, dtype and device of each.


def find_graphs(tensors: Sequence[Any], options: RenderOptions) -> "_CallGraphs | None":
    """Return the graphs of calls like this one; None if there was none yet, or it is not for a graph.

    tensors, options: as their user passed them. If calls like this one are known, they fit.
    """
    try:
        if not on_gpu(tensors[0]):
            return None
        signature = _signature(tensors, options)
        with _lock:
            graphs = _graphs.get(signature)
            if graphs is not None:
                _graphs.move_to_end(signature)
    except (AttributeError, TypeError, RuntimeError):
        return None
    return None if graphs is None or is_capturing(tensors[0].device) else graphs


def add_graphs(tensors: Sequence[Tensor], options: RenderOptions) -> "_CallGraphs | None":
    """Return the graphs of calls like this one, which need not be known; None if it is not for a graph.

    Args:
        tensors: as _CallGraphs.replay() takes them, of one device.
        options: of the image.
    """
    first, features = tensors[0], _features_of(tensors)
    if not on_gpu(first) or first.dtype != torch.float32:
        return None
    if options.max_intersections is not None or options.deterministic:
        return None
    signature = _signature(tensors, options)
    small = 0 < len(features) <= (MAX_DIFFERENTIABLE if signature.differentiable else MAX_GAUSSIANS)
    if not small or options.width * options.height > MAX_PIXELS or is_capturing(first.device):
        return None
    return _graphs_of(signature)


def has_room(tensors: Sequence[Tensor], options: RenderOptions, memory: int) -> bool:
    """Return whether a graph of the call would hold a small part of a GPU's memory, in bytes."""
    count, channels = _features_of(tensors).shape
    # Copies, 2D Gaussians, lists and gradients by Gaussian; images and their gradients.
    bytes_needed = 4 * (count * (80 + 8 * channels) + options.width * options.height * (4 + 3 * channels))
    return bytes_needed <= MAX_SHARE * memory


def _features_of(tensors: Sequence[Tensor]) -> Tensor:
    return tensors.features if isinstance(tensors, Splats) else tensors[FEATURES]


def _memory_of(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).total_memory if device.type == "cuda" else 1 << 40


def on_gpu(tensor: Tensor) -> bool:
    """Return whether CUDA graphs can render it."""
    return tensor.is_cuda


def _signature(tensors: Sequence[Tensor], options: RenderOptions) -> _Signature:
    differentiable = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    layouts = tuple((tensor.shape, tensor.dtype, tensor.device) for tensor in tensors)
    return _Signature(options, stream_handle(tensors[0].device), differentiable, layouts)


class GraphRender:
    """A render by a CUDA graph, which no other call uses until the adjoints are freed.

    Attributes:
        image: [H, W, C].
        transmittance: [H, W].
        means2d: [N, 2] of a whole call, else None.
        depths: [N] of a whole call, else None.
        extents: [N, 2].
        intersections: the number that fits() found.
    """

    def __init__(self, graphs: "_CallGraphs", graph: RenderGraph, results: Sequence[Tensor]) -> None:
        """Lease the graph."""
        self._graphs, self._graph, self._lease = graphs, graph, _Lease(graphs.idle, graph)
        self.means2d: Tensor | None = None
        self.depths: Tensor | None = None
        if graph.projects:
            self.image, self.transmittance, self.means2d, self.depths, self.extents = results
        else:
            self.image, self.transmittance, self.extents = results
        self.intersections = 0

    @property
    def result(self) -> BlendResult:
        """The blend, with the adjoint of 2D Gaussians."""
        return BlendResult(self.image, self.transmittance, self._lease.adjoint)

    def fits(self) -> bool:
        """Wait until the GPU has counted the intersections; return whether the graph has memory for them.

        If not, the render is not to be used.
        """
        self.intersections = self._graph.count_intersections()
        if self.intersections <= self._graph.max_intersections:
            return True
        self._graphs.grow(self.intersections)
        return False

    def project(self, gaussians: Sequence[Tensor]) -> "GraphProjection":
        """Return the 2D Gaussians as functions of means, log_scales, quaternions, opacities, pose and lens."""
        means2d, depths, extents = self.means2d, self.depths, self.extents
        assert means2d is not None and depths is not None, "the graph begins with 2D Gaussians"
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in gaussians):
            return GraphProjection(*_apply_projection(self._lease, means2d, depths, extents, *gaussians))
        return GraphProjection(means2d, depths, extents, None)

    def blend(self, means2d: Tensor, link: Tensor | None, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return image and transmittance as functions of the centres, of project()'s link and of the features."""
        if torch.is_grad_enabled() and (link is not None or features.requires_grad):
            return _apply_blend(self._lease, self.image, self.transmittance, means2d, link, features)
        return self.image, self.transmittance


class GraphProjection(NamedTuple):
    """2D Gaussians that a graph projected.

    Attributes:
        means2d: [N, 2].
        depths: [N].
        extents: [N, 2].
        link: through which the blend's gradients reach the projection; None without gradients.
    """

    means2d: Tensor
    depths: Tensor
    extents: Tensor
    link: Tensor | None


class _GraphProjection(torch.autograd.Function):
    @staticmethod
    def forward(ctx, lease: "_Lease", means2d: Tensor, depths: Tensor, extents: Tensor, *gaussians: Tensor):
        ctx.lease = lease
        # Never read: that they are saved makes torch refuse what was changed in place, as it does elsewhere.
        ctx.save_for_backward(*gaussians, extents)
        ctx.mark_non_differentiable(extents)
        ctx.set_materialize_grads(False)
        return means2d, depths, extents, lease.adjoint_graph.link.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx, by_means2d, by_depths, _, vector):
        _ = ctx.saved_tensors
        lease = ctx.lease
        if not keeps_graph():
            ctx.lease = None
        gradients = lease.adjoint_graph.by_gaussians(vector, by_means2d, by_depths, ctx.needs_input_grad[4:])
        return None, None, None, None, *gradients


class _GraphBlend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, lease: "_Lease", image: Tensor, transmittance: Tensor, means2d, link, features):
        ctx.lease = lease
        ctx.save_for_backward(features)
        ctx.set_materialize_grads(False)
        return image, transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx, by_image, by_transmittance):
        _ = ctx.saved_tensors
        lease = ctx.lease
        if not keeps_graph():
            ctx.lease = None
        if by_image is None and by_transmittance is None:
            return (None,) * 6
        adjoint = lease.adjoint_graph
        vector = adjoint.replay(by_image, by_transmittance)
        by_link = vector if ctx.needs_input_grad[4] else None
        return None, None, None, adjoint.by_means2d(vector), by_link, adjoint.by_features(vector)


_apply_projection, _apply_blend = direct_apply(_GraphProjection), direct_apply(_GraphBlend)


@dataclass
class _CallGraphs:
    """The graphs of calls of one kind.

    Attributes:
        differentiable: whether the calls need adjoints.
        launched: calls that were launched.
        captured: graphs that were captured since the memory last grew.
        intersections: the least number that the next graph allocates memory for.
        idle: graphs that no call holds.
    """

    differentiable: bool = False
    launched: int = 0
    captured: int = 0
    intersections: int = 0
    idle: list[RenderGraph] = field(default_factory=list)

    def take(self, capture: Callable[[int], RenderGraph]) -> RenderGraph | None:
        """Return a graph that is the caller's until it is idle again; None for a call that is to be launched."""
        if self.idle:
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

    def replay(
        self, tensors: Sequence[Tensor], options: RenderOptions, outputs: Sequence[Tensor] = ()
    ) -> GraphRender | None:
        """Render by a CUDA graph, or return None if the call is to be launched instead.

        Args:
            tensors: the seven tensors of a call, or Splats.
            options: of the image.
            outputs: for Splats (extents,), to be written to.
        """

        def capture(intersections: int) -> RenderGraph:
            if not has_room(tensors, options, _memory_of(tensors[0].device)):
                raise torch.OutOfMemoryError("a graph would hold too much of the GPU's memory")
            with torch.inference_mode(False), torch.no_grad():
                return RenderGraph(tensors, options, intersections, self.differentiable)

        with torch.no_grad():
            graph = self.take(capture)
            return None if graph is None else GraphRender(self, graph, graph.replay(tensors, outputs))

    def grow(self, intersections: int) -> None:
        """Let new graphs be captured, because one had too little memory for this many intersections."""
        self.intersections, self.captured, self.idle = max(intersections, self.intersections), 0, []


class _Lease:
    """Keeps a graph from other calls for as long as it lives."""

    def __init__(self, idle: list[RenderGraph], graph: RenderGraph) -> None:
        self._idle, self._graph = idle, graph

    @property
    def adjoint_graph(self) -> AdjointGraph:
        adjoint = self._graph.adjoint_graph
        assert adjoint is not None, "the graph is not differentiable, or begins with 2D Gaussians"
        return adjoint

    def adjoint(self, by_image: Tensor, by_transmittance: Tensor | None) -> Tensor:
        return self._graph.adjoint(by_image, by_transmittance)

    def __del__(self) -> None:
        self._idle.append(self._graph)


_lock = threading.Lock()
_graphs: OrderedDict[_Signature, _CallGraphs] = OrderedDict()


def clear_graphs() -> None:
    """Free all graphs and their memory."""
    _graphs.clear()


atexit.register(clear_graphs)  # Graphs must be freed before CUDA is.


def _graphs_of(signature: _Signature) -> _CallGraphs:
    with _lock:
        graphs = _graphs.setdefault(signature, _CallGraphs(signature.differentiable))
        _graphs.move_to_end(signature)
        while len(_graphs) > MAX_SIZES:
            _graphs.popitem(last=False)
    return graphs
