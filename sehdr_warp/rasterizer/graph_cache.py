"""Replay renders that repeat as CUDA graphs: at the GPU's pace instead of Python's.

Rendering 2D Gaussians takes some ten launches; called from Python one by one, they take longer than a small image does.
After a few calls with the same sizes the next one is captured as CUDA graphs on memory of its own: inputs are copied
in, outputs are copied out.

This applies to calls of rasterize() and, with packed=False, of gsplat's rasterization(). A training captures its whole
step as one CUDA graph (training/step_graphs.py); within it, and with max_intersections, calls are launched.
"""

import atexit
import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .blending import BlendResult
from .captured_backward import GradientMemory
from .captured_render import CapturedRender
from .cuda_graphs import is_capturing, replays_are_off
from .projection import with_projection_gradient
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
    dtype: torch.dtype
    device: int
    shapes: tuple[torch.Size, ...]


def find_pool(tensors: Sequence[Any], options: RenderOptions) -> "GraphPool | None":
    """Return the CUDA graphs of calls like this one; None if there are none yet, or the call cannot be captured.

    tensors, options: as their user passed them. If calls like this one are known, they were checked before.
    """
    try:
        # 640.0 equals 640, and is refused where arguments are checked.
        if not on_gpu(tensors[0]) or type(options.width) is not int or type(options.height) is not int:
            return None
        pool = _pools.get(_signature(tensors, options))
    except (AttributeError, TypeError, RuntimeError):
        return None
    if pool is None or replays_are_off() or is_capturing(tensors[0].device):
        return None
    pool.last_use = next(_uses)
    return pool


def get_or_create_pool(tensors: Sequence[Tensor], options: RenderOptions) -> "GraphPool | None":
    """Return the CUDA graphs of calls like this one, an empty pool at first; None if the call cannot be captured.

    Args:
        tensors: as GraphPool.begin_render() takes them, of one device.
        options: of the image.
    """
    first = tensors[0]
    if not on_gpu(first) or first.dtype != torch.float32:
        return None
    if options.max_intersections is not None or options.deterministic or replays_are_off():
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
    """Return a call's signature; raise TypeError if dtypes or devices differ."""
    first = tensors[0]
    dtype, device = first.dtype, first.get_device()
    shapes, requires_grad = [], False
    for tensor in tensors:
        if tensor.dtype is not dtype or tensor.get_device() != device:
            raise TypeError("tensors differ in dtype or device")
        shapes.append(tensor.shape)
        requires_grad = requires_grad or tensor.requires_grad
    differentiable = requires_grad and torch.is_grad_enabled()
    return _Signature(options, stream_handle(first.device), differentiable, dtype, device, tuple(shapes))


class ReplayedRender:
    """A render by a CUDA graph, which no other call uses for as long as the backward passes of this render exist.

    They hold the graph until the autograd graph of the render is freed; a render without gradients holds it as long as
    this object lives.

    Attributes:
        result: of the blend.
        intersections: of the render; 0 before fits().
        means2d: [N, 2]; this and the next three if the CUDA graph began with 3D Gaussians.
        depths: [N].
        extents: [N, 2].
        conics_opacities: stands for both in the autograd graph, see CapturedBackward; None without gradients.
    """

    result: BlendResult
    means2d: Tensor
    depths: Tensor
    extents: Tensor
    conics_opacities: Tensor | None

    def __init__(self, pool: "GraphPool", graph: "CapturedRender") -> None:
        """Keep the CUDA graph from other calls."""
        self._pool, self._in_use = pool, _GraphInUse(pool.idle, graph)
        self.intersections = 0

    def render(self, tensors: Sequence[Tensor]) -> None:
        """Render from the seven tensors of a call, of which the attributes are differentiable functions."""
        if not self._pool.differentiable:
            self.means2d, self.depths, self.extents = self._replay(tensors, (), ())
            self.conics_opacities = None
            return
        means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics = tensors
        gaussians = means, log_scales, quaternions, opacities, world_to_camera, intrinsics
        needed = [tensor.requires_grad for tensor in gaussians]
        conics_opacities = self._in_use.graph.backward.conics_opacities
        assert conics_opacities is not None, "the CUDA graph begins with 2D Gaussians"
        means2d, depths, extents = self._replay(tensors, (), needed, copies_features=_is_trained(features))
        outputs = means2d, conics_opacities.detach(), depths, extents
        outputs = with_projection_gradient(outputs, gaussians, self._in_use.project_backward)
        self.means2d, self.conics_opacities, self.depths, self.extents = outputs

    def render_projected(self, tensors: Sequence[Tensor], extents: Tensor) -> None:
        """Render from flatten() of RasterInputs; write the extents that are left, see pack_splats()."""
        with torch.no_grad():
            self._replay(tensors, (extents,), (), copies_features=_is_trained(tensors[-1]))

    def _replay(
        self,
        tensors: Sequence[Tensor],
        outputs: Sequence[Tensor],
        needed: Sequence[bool],
        *,
        copies_features: bool = False,
    ) -> Sequence[Tensor]:
        """Replay the CUDA graph and prepare a backward pass, with options of CapturedBackward.allocate()."""
        image, transmittance, others, gradients = self._in_use.graph.replay(tensors, outputs)
        self.result = BlendResult(image, transmittance, self._in_use.blend_backward)
        if self._pool.differentiable:
            self._in_use.prepare(needed, gradients, copies_features=copies_features)
        return others

    def fits(self) -> bool:
        """Wait until the GPU has counted the intersections; return whether the graph has memory for them.

        If not, the render is not to be used.
        """
        graph = self._in_use.graph
        self.intersections = graph.count_intersections()
        if self.intersections <= graph.max_intersections:
            return True
        self._pool.grow(self.intersections)
        return False


def _is_trained(tensor: Tensor) -> bool:
    """Return whether torch keeps the tensor's gradient, and so would copy one that is not contiguous."""
    return tensor.is_leaf and tensor.requires_grad


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
        last_use: number of the last call.
    """

    differentiable: bool = False
    max_graphs: int = MAX_GRAPHS
    launched: int = 0
    captured: int = 0
    intersections: int = 0
    idle: list[CapturedRender] = field(default_factory=list)
    last_use: int = 0

    def take(self, capture: Callable[[int], CapturedRender]) -> CapturedRender | None:
        """Return a CUDA graph that is the caller's until it is idle again; None for a call that is to be launched."""
        try:
            return self.idle.pop()
        except IndexError:
            pass
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

    def begin_render(self, tensors: Sequence[Tensor], options: RenderOptions) -> ReplayedRender | None:
        """Return a render by a CUDA graph that is to be made, or None if the call is to be launched instead.

        Args:
            tensors: the seven tensors of a call, or flatten() of RasterInputs.
            options: of the image.
        """

        def capture(intersections: int) -> CapturedRender:
            with torch.inference_mode(False), torch.no_grad():
                return CapturedRender(tensors, options, intersections, self.differentiable)

        graph = self.take(capture)
        return None if graph is None else ReplayedRender(self, graph)

    def grow(self, intersections: int) -> None:
        """Let new CUDA graphs be captured, because one had too little memory for this many intersections."""
        self.intersections, self.captured, self.idle = max(intersections, self.intersections), 0, []


class _GraphInUse:
    """Keeps a CUDA graph from other calls, and returns it to the idle ones when it is deleted."""

    def __init__(self, idle: list[CapturedRender], graph: CapturedRender) -> None:
        self._idle, self.graph = idle, graph
        self._needed: Sequence[bool] = ()
        self._copies_features = False
        self._next: GradientMemory | None = None  # Of the next backward pass of the blend.
        self._between: GradientMemory | None = None  # Of the last one, until that of the projection.

    def prepare(self, needed: Sequence[bool], gradients: Tensor | None, *, copies_features: bool) -> None:
        """Prepare a backward pass; see CapturedBackward.allocate() and ReplayResult.gradients."""
        self._needed, self._copies_features = needed, copies_features
        if gradients is not None:
            self._next = self._allocate(gradients)

    def _allocate(self, zeros: Tensor | None = None) -> GradientMemory:
        return self.graph.backward.allocate(self._needed, copies_features=self._copies_features, zeros=zeros)

    def blend_backward(self, grad_image: Tensor, grad_transmittance: Tensor | None) -> Sequence[Tensor]:
        memory, self._next = self._next or self._allocate(), None
        self._between = memory if any(self._needed) else None
        return self.graph.backward.blend(memory, grad_image, grad_transmittance)

    def project_backward(
        self, inputs: Sequence[Tensor], visibility: Tensor, upstream: Sequence[Tensor | None], needed: Sequence[bool]
    ) -> Sequence[Tensor | None]:
        grad_means2d, zeros, grad_depths, _ = upstream
        memory, self._between = self._between, None
        if memory is None or memory.zeros is not zeros:  # Passes overlap, or nothing reached the image.
            memory = self._allocate(zeros)
        return self.graph.backward.project(memory, grad_means2d, grad_depths)

    def __del__(self) -> None:
        self._idle.append(self.graph)


_lock = threading.Lock()
_pools: dict[_Signature, GraphPool] = {}
_uses = count(1)


def clear_graphs() -> None:
    """Free all CUDA graphs and their memory."""
    _pools.clear()


atexit.register(clear_graphs)  # CUDA graphs must be freed before CUDA is.


def _pool_of(signature: _Signature, max_graphs: int) -> GraphPool:
    with _lock:
        pool = _pools.setdefault(signature, GraphPool(signature.differentiable, max_graphs))
        pool.last_use = next(_uses)
        while len(_pools) > MAX_SIZES:
            del _pools[min(_pools, key=lambda key: _pools[key].last_use)]
    return pool
