"""One render as a CUDA graph on memory of its own, and its backward passes."""

import ctypes
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels.caller_memory import write_last
from ..kernels.project import projection_kernel
from .block_blending import BlockBackward, blend_on_cuda, fixed_blend_blocks
from .caller_memory import CallerMemory
from .captured_backward import CapturedBackward, GradientLayout
from .cuda_graphs import CudaGraphRunner
from .projection import ProjectedGaussians, RasterInputs, project_to_camera, projection_parameters
from .render_options import MAX_INTERSECTIONS, RenderOptions
from .tile_lists import (
    MAX_SINGLE_SORT,
    IntersectionOffsets,
    PackedSplats,
    TileLists,
    build_tile_lists,
    fixed_pack_splats,
    order_intersections,
    pack_splats,
)
from .warp_launch.launching import FixedLaunch, fixed_launch, launch, warp_scalar, warp_stream

MAX_COPIED_GAUSSIANS = MAX_SINGLE_SORT
"""More of them, without a backward pass, are read where they are, and the image is written where it stays."""
SPINS = 200  # Looks at the number of intersections before other threads may run in between, and from query to query.
HEADROOM = 1.25  # Memory for intersections, as a multiple of those of the captured call.
MIN_INTERSECTIONS = 1 << 12
FEATURES = 4
"""Index of features among a call's seven tensors, those that rasterize() takes first."""
_let_others_run: Callable[[], object] = getattr(os, "sched_yield", partial(time.sleep, 0))
"""Lets other threads run. On Linux time.sleep(0) takes 50 us, to which timers are rounded up."""


class ReplayResult(NamedTuple):
    """Tensors that a replayed CUDA graph has written.

    Attributes:
        image: [H, W, C].
        transmittance: [H, W].
        others: means2d, depths and extents; extents alone if the graph begins with 2D Gaussians.
        gradients: zeros for the gradients of a backward pass, see GradientLayout; None if that pass allocates them.
    """

    image: Tensor
    transmittance: Tensor
    others: Sequence[Tensor]
    gradients: Tensor | None


class CapturedRender:
    """One render on fixed memory as a CUDA graph, which also copies the number of intersections to the host.

    The graph copies inputs in and results out, see CallerMemory. With many Gaussians and without gradients these copies
    would take a sixth of the time: what reads inputs and what writes the image is then launched on the caller's memory,
    before and after the graph.

    Args:
        tensors: the seven tensors of a call, or flatten() of RasterInputs.
        options: of the image.
        intersections: the least number to allocate memory for.
        differentiable: whether its backward passes may be called.

    Attributes:
        max_intersections: that there is memory for.
        backward: the backward passes, if differentiable.
    """

    backward: CapturedBackward

    def __init__(
        self, tensors: Sequence[Tensor], options: RenderOptions, intersections: int, differentiable: bool
    ) -> None:
        """Launch the render once, then capture it."""
        width, height, threshold = options.width, options.height, options.alpha_threshold
        projects = len(tensors) == FEATURES + 3
        many = len(tensors[0]) > MAX_COPIED_GAUSSIANS
        self._copies = differentiable or options.depth or not projects or not many
        inputs = [tensor.detach().contiguous() for tensor in tensors]
        if self._copies:
            inputs = [tensor.clone() for tensor in inputs]
        device = inputs[0].device
        channels = inputs[FEATURES].shape[1] + options.depth if projects else inputs[-1].shape[1]
        image, transmittance = inputs[0].new_empty(height, width, channels), inputs[0].new_empty(height, width)
        counter = torch.empty(1, dtype=torch.int64, device="cpu", pin_memory=True)
        self._counter, self._count = counter, ctypes.c_int64.from_address(counter.data_ptr())
        self._stream = torch.cuda.current_stream(device)
        self._runner, self._callers = CudaGraphRunner(device), CallerMemory(device)

        def begin() -> tuple[RasterInputs, PackedSplats]:
            splats = _project(inputs, options) if projects else unflatten(inputs)
            pads = not self._copies or channels % 4 > 0
            return splats, pack_splats(splats, threshold, width, height, pads=pads)

        def count(splats: RasterInputs, packed: PackedSplats) -> IntersectionOffsets:
            depths, extents = splats.projected.depths, splats.projected.extents
            offsets = order_intersections(packed.counts, depths, extents, keep_emit_order=False)
            launch(write_last, 1, offsets.cumulative_counts, counter)  # What follows waits longer for a copy.
            return offsets

        def list_tiles(splats: RasterInputs, packed: PackedSplats, offsets: IntersectionOffsets) -> TileLists:
            depths, extents, limit = splats.projected.depths, splats.projected.extents, self.max_intersections
            return build_tile_lists(packed, offsets, depths, extents, width, height, limit, keep_emit_order=False)

        def blend(splats: RasterInputs, packed: PackedSplats, lists: TileLists) -> BlockBackward:
            features = splats.features
            return blend_on_cuda(features, lists, packed, image, transmittance, threshold, False, keeps_padded=True)

        def middle(splats: RasterInputs, packed: PackedSplats) -> TileLists:
            return list_tiles(splats, packed, count(splats, packed))

        def outputs_of(splats: RasterInputs) -> list[Tensor]:
            means2d, _, depths, _, extents = splats.projected
            return [means2d, depths, extents] if projects else [extents]

        def whole() -> tuple[RasterInputs, BlockBackward]:
            self._callers.read(inputs)
            splats, packed = begin()
            backward = blend(splats, packed, middle(splats, packed))
            self._callers.write([image, transmittance, *outputs_of(splats)], zeros)
            return splats, backward

        gaussians = _without_features(inputs) if projects else ()
        splats, packed = begin()
        # Launched once: nothing may be compiled or loaded during a capture, and it tells how much memory is needed.
        with self._runner.on_capture_stream():
            offsets = count(splats, packed)
            limit = int(HEADROOM * max(intersections, int(offsets.cumulative_counts[-1])))
            self.max_intersections = min(max(MIN_INTERSECTIONS, limit), MAX_INTERSECTIONS)
            layout = GradientLayout(blend(splats, packed, list_tiles(splats, packed, offsets)), gaussians)
            # With more Gaussians memory is worth more than the host's time.
            zeros = layout.size if differentiable and not many else 0
            if self._copies:
                self._callers.read(inputs)
                self._callers.write([image, transmittance, *outputs_of(splats)], zeros)
            del offsets
        self._gradients_like = layout.like if zeros else None
        if self._copies:
            del splats, packed
            splats, backward = self._runner.capture(None, whole)
            if differentiable:
                self.backward = CapturedBackward(layout, backward, gaussians, options, splats.projected)
        else:
            lists = self._runner.capture(None, lambda: middle(splats, packed))
            assert packed.padded is not None
            self._project = _fixed_projection(inputs, options, splats.projected)
            self._pack = fixed_pack_splats(splats, packed, threshold, width, height)
            self._blend = fixed_blend_blocks(packed.padded, lists, packed, image, transmittance, threshold)
        self._outputs = [*([image, transmittance] if self._copies else ()), *outputs_of(splats)]
        self._image_shape = image.shape

    def replay(self, tensors: Sequence[Tensor], outputs: Sequence[Tensor]) -> ReplayResult:
        """Render. Call count_intersections() before the next replay: the GPU has then read the table of addresses.

        outputs: contiguous, to write what follows image and transmittance to. By default they are new tensors.
        """
        if self._count.value < 0:  # The last call ended before its count was read, for example by lack of memory.
            self._stream.synchronize()
        self._count.value = -1
        if not self._copies:
            return self._launch(tensors)
        known = len(self._outputs) - len(outputs)
        results = [*map(torch.empty_like, self._outputs[:known]), *outputs]
        gradients = None if self._gradients_like is None else torch.empty_like(self._gradients_like)
        inputs = [tensor.contiguous() for tensor in tensors]  # Copies must live until the graph is launched.
        self._callers.set(inputs, results, gradients)
        self._runner.replay()
        image, transmittance, *others = results
        return ReplayResult(image, transmittance, others, gradients)

    def _launch(self, tensors: Sequence[Tensor]) -> ReplayResult:
        """Do what replay() does without copies of the features and of the image."""
        inputs = [tensor.contiguous() for tensor in tensors]
        features = inputs.pop(FEATURES)
        stream = warp_stream(features.device)
        self._project.launch((), [tensor.data_ptr() for tensor in inputs], stream)
        self._pack.launch((), (features.data_ptr(),), stream)
        self._runner.replay()
        image, transmittance = features.new_empty(self._image_shape), features.new_empty(self._image_shape[:2])
        self._blend.launch((), (image.data_ptr(), transmittance.data_ptr()), stream)
        others = [torch.empty_like(output) for output in self._outputs]
        torch._foreach_copy_(others, self._outputs)  # pyright: ignore[reportPrivateImportUsage]
        return ReplayResult(image, transmittance, others, None)

    def count_intersections(self) -> int:
        """Wait for the last render's count; return it. Those beyond max_intersections were left out."""
        count, looks = self._count, 0
        while count.value < 0:
            looks += 1
            if looks > SPINS:
                _let_others_run()
            if looks % SPINS == 0 and self._stream.query() and count.value < 0:
                raise RuntimeError("the GPU has not counted the intersections of a render")
        return count.value


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


def _fixed_projection(inputs: Sequence[Tensor], options: RenderOptions, projected: ProjectedGaussians) -> FixedLaunch:
    """Return the launch of _project() for any inputs, to the same outputs."""
    gaussians = _without_features(inputs)
    kernel = projection_kernel(warp_scalar(projected.depths.dtype), options.antialiased)
    arguments = *gaussians, *projection_parameters(options), None, *projected
    return fixed_launch(kernel, len(projected.depths), *arguments, whole=gaussians)


def _without_features(inputs: Sequence[Tensor]) -> list[Tensor]:
    """Return the inputs of the projection among a call's seven tensors."""
    return [tensor for place, tensor in enumerate(inputs) if place != FEATURES]
