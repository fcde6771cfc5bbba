"""Replay renders that repeat as CUDA graphs: at the GPU's pace instead of Python's.

Rendering 2D Gaussians takes some ten launches; called from Python one by one, they take longer than a small image does.
After a few calls with the same sizes the next one is captured as CUDA graphs on memory of its own: inputs are copied
in, outputs are copied out.

This applies to calls of rasterize() and of gsplat's rasterization(). A training captures its whole step as one CUDA
graph (training/step_graphs.py); within it, and with max_intersections, calls are launched.
"""

import atexit
import ctypes
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels.project import projection_kernel
from .blending import Backward, BlendResult, BlockBackward, blend_on_cuda
from .cuda_graphs import CudaGraphRunner, is_capturing
from .projection import (
    ProjectedGaussians,
    ProjectionAdjoint,
    RasterInputs,
    adjoint_arguments,
    project_to_camera,
    projection_parameters,
)
from .render_options import MAX_INTERSECTIONS, RenderOptions
from .tile_lists import (
    MAX_SINGLE_SORT,
    IntersectionOffsets,
    PackedSplats,
    build_tile_lists,
    order_intersections,
    pack_splats,
)
from .warp_launch.launching import fixed_launch, stream_handle, warp_scalar, warp_stream

LOG = logging.getLogger(__name__)

WARMUP_CALLS = 4  # Launched calls of a size before one is captured: a capture takes the time of some twenty of them.
MAX_SIZES = 3  # Sizes of calls with CUDA graphs, the most recent ones.
MAX_GRAPHS = 4  # CUDA graphs of a size: each holds a render until its backward pass.
MAX_PIXELS = 1 << 21  # Larger images keep the GPU busy without CUDA graphs.
MAX_GAUSSIANS = 1 << 21  # Without a backward pass; with one the host is the bottleneck only up to MAX_SINGLE_SORT.
HEADROOM = 1.25  # Memory for intersections, as a multiple of those of the captured call.
MIN_INTERSECTIONS = 1 << 12


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
    small = 0 < len(first) <= (MAX_SINGLE_SORT if signature.differentiable else MAX_GAUSSIANS)
    if not small or options.width * options.height > MAX_PIXELS or is_capturing(first.device):
        return None
    return _pool_of(signature)


def on_gpu(tensor: Tensor) -> bool:
    """Return whether CUDA graphs can render it."""
    return tensor.is_cuda


def _signature(tensors: Sequence[Tensor], options: RenderOptions) -> _Signature:
    differentiable = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    layouts = tuple((tensor.shape, tensor.dtype, tensor.device) for tensor in tensors)
    return _Signature(options, stream_handle(tensors[0].device), differentiable, layouts)


FEATURES = 4
"""Index of features among a call's seven tensors, those that rasterize() takes first."""


class ReplayedRender:
    """A render by a CUDA graph, which no other call uses for as long as the backward passes of this render exist.

    They hold a lease of the graph. It ends with the last reference to `result` or `projection_adjoint`: when the
    autograd graph of the render is freed, or at once for a render without gradients.

    Attributes:
        projected: 2D Gaussians; None if the CUDA graph began with them. Their conics and opacities are its memory.
        result: of the blend.
    """

    def __init__(self, pool: "GraphPool", graph: "CapturedRender", result: Sequence[Tensor]) -> None:
        """Lease the CUDA graph."""
        self._pool, self._graph = pool, graph
        lease = _Lease(pool.idle, graph)
        image, transmittance, *others = result
        self.result = BlendResult(image, transmittance, lease.backward)
        self.projected: ProjectedGaussians | None = None
        if graph.projection_adjoint is not None:
            means2d, depths, extents = others
            fixed = graph.splats.projected
            conics, opacities = fixed.conics.detach(), fixed.opacities.detach()
            self.projected = ProjectedGaussians(means2d, conics, depths, opacities, extents)
        self.projection_adjoint: ProjectionAdjoint = lease.projection_adjoint
        self.intersections = 0

    def fits(self) -> bool:
        """Wait until the GPU has counted the intersections; return whether the graph has memory for them.

        If not, the render is not to be used.
        """
        self.intersections = self._graph.count_intersections()
        if self.intersections <= self._graph.max_intersections:
            return True
        self._pool.grow(self.intersections)
        return False


class CapturedRender:
    """One render on fixed memory, in two CUDA graphs, between which the number of intersections is copied to the host.

    Args:
        tensors: the seven tensors of a call, or flatten() of RasterInputs.
        options: of the image.
        intersections: the least number to allocate memory for.
        differentiable: whether its backward passes may be called.
    """

    def __init__(
        self, tensors: Sequence[Tensor], options: RenderOptions, intersections: int, differentiable: bool
    ) -> None:
        """Launch the render once, then capture it."""
        width, height, threshold = options.width, options.height, options.alpha_threshold
        inputs = [tensor.detach().clone(memory_format=torch.contiguous_format) for tensor in tensors]
        device = inputs[0].device
        projects = len(inputs) == 7
        channels = inputs[FEATURES].shape[1] + options.depth if projects else inputs[-1].shape[1]
        image, transmittance = inputs[0].new_empty(height, width, channels), inputs[0].new_empty(height, width)
        counter = torch.empty(1, dtype=torch.int64, device="cpu", pin_memory=True)
        self._counter, self._count = counter, ctypes.c_int64.from_address(counter.data_ptr())
        self._counted, self._stream = torch.cuda.Event(), torch.cuda.current_stream(device)
        self._counting = CudaGraphRunner(device)
        self._blending = CudaGraphRunner(device, self._counting.stream)

        def count() -> tuple[RasterInputs, PackedSplats, IntersectionOffsets]:
            splats = _project(inputs, options) if projects else unflatten(inputs)
            packed = pack_splats(splats, threshold, width, height)
            depths, extents = splats.projected.depths, splats.projected.extents
            offsets = order_intersections(packed.counts, depths, extents, keep_emit_order=False)
            counter.copy_(offsets.cumulative_counts[-1:], non_blocking=True)
            return splats, packed, offsets

        def blend(
            splats: RasterInputs, packed: PackedSplats, offsets: IntersectionOffsets, limit: int
        ) -> BlockBackward:
            depths, extents = splats.projected.depths, splats.projected.extents
            lists = build_tile_lists(packed, offsets, depths, extents, width, height, limit, keep_emit_order=False)
            return blend_on_cuda(splats.features, lists, packed, image, transmittance, threshold, False)

        # Launched once: nothing may be compiled or loaded during a capture, and it tells how much memory is needed.
        with self._counting.on_capture_stream():
            splats, packed, offsets = count()
            limit = int(HEADROOM * max(intersections, int(offsets.cumulative_counts[-1])))
            self.max_intersections = min(max(MIN_INTERSECTIONS, limit), MAX_INTERSECTIONS)
            blend(splats, packed, offsets, self.max_intersections)
            del splats, packed, offsets
        self.splats, packed, offsets = self._counting.capture(None, count)
        limit = self.max_intersections
        backward = self._blending.capture(None, lambda: blend(self.splats, packed, offsets, limit))
        self.backward: Backward = backward.on_fixed_memory() if differentiable else backward
        """Backward pass of the last render; one launch, which needs no CUDA graph."""
        projected = self.splats.projected
        self.projection_adjoint = _projection_adjoint(inputs, options, projected) if projects else None
        outputs = projected.means2d, projected.depths, projected.extents
        self._inputs = inputs
        self._outputs = [image, transmittance, *(outputs if projects else outputs[2:])]

    def replay(self, tensors: Sequence[Tensor], outputs: Sequence[Tensor]) -> list[Tensor]:
        """Render; return image and transmittance, and what follows them among the outputs.

        outputs: to write the latter to. By default they are new tensors.
        """
        torch._foreach_copy_(self._inputs, tuple(tensors))  # pyright: ignore[reportPrivateImportUsage]
        self._counting.replay()
        self._counted.record(self._stream)
        self._blending.replay()
        known = len(self._outputs) - len(outputs)
        results = [*map(torch.empty_like, self._outputs[:known]), *outputs]
        torch._foreach_copy_(results, self._outputs)  # pyright: ignore[reportPrivateImportUsage]
        return results

    def count_intersections(self) -> int:
        """Wait for the last render's count; return it. Those beyond max_intersections were left out."""
        self._counted.synchronize()
        return self._count.value


def _project(inputs: Sequence[Tensor], options: RenderOptions) -> RasterInputs:
    means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics = inputs
    projected = project_to_camera(means, log_scales, quaternions, opacities, world_to_camera, intrinsics, options)
    if options.depth:
        features = torch.cat([features, projected.depths[:, None]], 1)
    return RasterInputs(projected, features)


def flatten(inputs: RasterInputs) -> tuple[Tensor, ...]:
    """Return the six tensors of RasterInputs."""
    return *inputs.projected, inputs.features


def unflatten(tensors: Sequence[Tensor]) -> RasterInputs:
    """Return the RasterInputs of flatten()."""
    return RasterInputs(ProjectedGaussians(*tensors[:-1]), tensors[-1])


def _projection_adjoint(
    inputs: Sequence[Tensor], options: RenderOptions, projected: ProjectedGaussians
) -> ProjectionAdjoint:
    """Return the adjoint of _project() on fixed memory; it reads the copies of its first and second argument there."""
    copies = [tensor for place, tensor in enumerate(inputs) if place != FEATURES]
    rows = [torch.empty_like(tensor) for tensor in projected[:-1]]
    whole = [torch.empty_like(tensor) for tensor in copies]
    kernel = projection_kernel(warp_scalar(projected.depths.dtype), options.antialiased)
    parameters = projection_parameters(options)
    arguments, gradients = adjoint_arguments(copies, parameters, projected.extents, (*rows, None), whole)
    count = len(projected.depths)
    fixed = fixed_launch(kernel, count, *arguments, gradients=gradients, rows=rows, whole=whole)
    device = projected.depths.device

    def adjoint(
        inputs: Sequence[Tensor], culling: Tensor, upstream: Sequence[Tensor | None], results: Sequence[Tensor | None]
    ) -> None:
        fixed.launch(upstream[:-1], results, warp_stream(device))

    return adjoint


@dataclass
class GraphPool:
    """The CUDA graphs of calls with one signature.

    Attributes:
        differentiable: whether the calls need backward passes.
        launched: calls that were launched.
        captured: CUDA graphs that were captured since the memory last grew.
        intersections: the least number that the next CUDA graph allocates memory for.
        idle: CUDA graphs that no call holds.
    """

    differentiable: bool = False
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

    def backward(self, grad_image: Tensor, grad_transmittance: Tensor | None) -> Tensor:
        return self._graph.backward(grad_image, grad_transmittance)

    def projection_adjoint(self, *arguments: Any) -> None:
        adjoint = self._graph.projection_adjoint
        assert adjoint is not None, "the CUDA graph begins with 2D Gaussians"
        adjoint(*arguments)

    def __del__(self) -> None:
        self._idle.append(self._graph)


_lock = threading.Lock()
_pools: OrderedDict[_Signature, GraphPool] = OrderedDict()


def clear_graphs() -> None:
    """Free all CUDA graphs and their memory."""
    _pools.clear()


atexit.register(clear_graphs)  # CUDA graphs must be freed before CUDA is.


def _pool_of(signature: _Signature) -> GraphPool:
    with _lock:
        pool = _pools.setdefault(signature, GraphPool(signature.differentiable))
        _pools.move_to_end(signature)
        while len(_pools) > MAX_SIZES:
            _pools.popitem(last=False)
    return pool
