"""One render on fixed memory, as CUDA graphs: forward, and for a whole call backward too."""

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels.project import projection_kernel
from .blending import Adjoint, BlockAdjoint, blend_on_cuda
from .cuda_graphs import CudaGraphRunner
from .gradients import kernel_layout
from .projection import project_to_camera
from .render_options import RenderOptions
from .tile_lists import (
    MAX_INTERSECTIONS,
    IntersectionOffsets,
    PackedSplats,
    Splats,
    build_tile_lists,
    order_intersections,
    pack_splats,
)
from .warp_launch.launching import fixed_launch, launch, warp_scalar, warp_stream

HEADROOM = 1.25  # Memory for intersections, as a multiple of those of the captured call.
MIN_INTERSECTIONS = 1 << 12
SPINS = 200
"""Looks at the number of intersections before the host waits for an event, which takes longer."""
FEATURES = 4
"""Place of features among a call's tensors: means, log_scales, quaternions, opacities, features, pose, lens."""


class RenderGraph:
    """One render on fixed memory; the number of intersections is copied to the host on the way.

    Args:
        tensors: the seven tensors of a call, or Splats.
        options: of the image.
        intersections: the least number to allocate memory for.
        differentiable: whether adjoints may be called.
    """

    def __init__(
        self, tensors: Sequence[Tensor], options: RenderOptions, intersections: int, differentiable: bool
    ) -> None:
        """Launch the render once, then capture it."""
        width, height, threshold = options.width, options.height, options.alpha_threshold
        inputs = [tensor.detach().clone(memory_format=torch.contiguous_format) for tensor in tensors]
        device = inputs[0].device
        self.projects = not isinstance(tensors, Splats)
        features = inputs[FEATURES] if self.projects else Splats(*inputs).features
        channels = features.shape[1] + (options.depth and self.projects)
        image, transmittance = features.new_empty(height, width, channels), features.new_empty(height, width)
        counter = torch.empty(1, dtype=torch.int64, pin_memory=True)
        counted = torch.cuda.Event(external=True)
        self._runner = CudaGraphRunner(device)

        def count() -> tuple[Splats, PackedSplats, IntersectionOffsets]:
            splats = _project(inputs, options) if self.projects else Splats(*inputs)
            packed = pack_splats(splats, threshold, width, height)
            offsets = order_intersections(packed.counts, splats.depths, splats.extents, unsorted=False)
            counter.copy_(offsets.ends[-1:], non_blocking=True)
            counted.record(torch.cuda.current_stream(device))
            return splats, packed, offsets

        def blend(splats: Splats, packed: PackedSplats, offsets: IntersectionOffsets, limit: int) -> BlockAdjoint:
            depths, extents = splats.depths, splats.extents
            lists = build_tile_lists(packed, offsets, depths, extents, width, height, limit, unsorted=False)
            return blend_on_cuda(splats.features, lists, packed, image, transmittance, threshold, False)

        def render() -> tuple[Splats, BlockAdjoint]:
            splats, packed, offsets = count()
            return splats, blend(splats, packed, offsets, self.max_intersections)

        # Launched once: nothing may be compiled or loaded during a capture, and it tells how much memory is needed.
        with self._runner.on_capture_stream():
            splats, packed, offsets = count()
            limit = int(HEADROOM * max(intersections, int(offsets.ends[-1])))
            self.max_intersections = min(max(MIN_INTERSECTIONS, limit), MAX_INTERSECTIONS)
            blend(splats, packed, offsets, self.max_intersections)
            del splats, packed, offsets
        splats, adjoint = self._runner.capture(None, render)
        self._counter, self._counted = counter, counted
        self._count, self._stream = ctypes.c_int64.from_address(counter.data_ptr()), torch.cuda.current_stream(device)
        outputs = (splats.means2d, splats.depths) if self.projects else ()
        self._inputs, self._outputs = inputs, [image, transmittance, *outputs, splats.extents]
        self.adjoint: Adjoint = adjoint
        """Adjoint of the last render, of 2D Gaussians."""
        self.adjoint_graph: AdjointGraph | None = None
        if differentiable and self.projects:
            self.adjoint_graph = AdjointGraph(self._runner, adjoint, inputs, splats, options)
        elif differentiable:
            self.adjoint = adjoint.on_fixed_memory()

    def replay(self, tensors: Sequence[Tensor], outputs: Sequence[Tensor]) -> list[Tensor]:
        """Render; return image and transmittance, and what follows them: of a call means2d and depths; extents.

        outputs: to write the latter to. By default they are new tensors.
        """
        self._count.value = -1
        torch._foreach_copy_(self._inputs, tuple(tensors))  # pyright: ignore[reportPrivateImportUsage]
        self._runner.replay()
        first_output = len(self._outputs) - len(outputs)
        results = [*map(torch.empty_like, self._outputs[:first_output]), *outputs]
        torch._foreach_copy_(results, self._outputs)  # pyright: ignore[reportPrivateImportUsage]
        return results

    def count_intersections(self) -> int:
        """Wait for the last render's count; return it. Those beyond max_intersections were left out."""
        count = self._count
        for _ in range(SPINS):
            if count.value >= 0:
                return count.value
        self._counted.synchronize()
        if count.value < 0:  # The event was that of an earlier replay.
            self._stream.synchronize()
        return count.value


def _project(inputs: Sequence[Tensor], options: RenderOptions) -> Splats:
    means, log_scales, quaternions, opacities, features, pose, lens = inputs
    projected = project_to_camera(means, log_scales, quaternions, opacities, pose, lens, options)
    if options.depth:
        features = torch.cat([features, projected.depths[:, None]], 1)
    return Splats(
        projected.means2d, projected.conics, projected.opacities, features, projected.depths, projected.extents
    )


class _Slot(NamedTuple):
    """Place of a contiguous tensor in a vector."""

    start: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def of(self, vector: Tensor) -> Tensor:
        """Return the tensor."""
        return vector.as_strided(self.shape, self.strides, self.start)


class AdjointGraph:
    """The backward pass of a whole call on fixed memory, as one CUDA graph.

    Its result is one vector: gradients by Gaussian as the blend sums them, those by features, and those by the other
    six tensors, which are right if 2D Gaussians have no gradient but that of the blend.

    Args:
        runner: of the render.
        adjoint: of the blend.
        inputs: the call's seven tensors.
        splats: the render's.
        options: of the render.
    """

    def __init__(
        self,
        runner: CudaGraphRunner,
        adjoint: BlockAdjoint,
        inputs: Sequence[Tensor],
        splats: Splats,
        options: RenderOptions,
    ) -> None:
        """Launch the backward pass once, then capture it."""
        count, channels = len(splats.depths), inputs[FEATURES].shape[1]
        blended = channels + options.depth
        shapes = [tensor.shape for place, tensor in enumerate(inputs) if place != FEATURES]
        self._gathered, self._features, *self._slots = _slots([(count, adjoint.columns), (count, channels), *shapes])
        self.size = self._slots[-1].start + self._slots[-1].shape[0]
        self.link = splats.depths.new_empty(1).expand(self.size)
        """A tensor of the vector's shape without memory of its own."""
        columns, self._depth = adjoint.columns, options.depth
        self._means2d = _Slot(blended + 3, (count, 2), (columns, 1))
        self._conics = _Slot(blended, (count, 3), (columns, 1))
        self._opacities, self._depths = _Slot(blended + 5, (count,), (columns,)), _Slot(channels, (count,), (columns,))
        self._by_image = splats.depths.new_zeros(*adjoint.transmittance.shape, blended)
        self._by_transmittance = torch.zeros_like(adjoint.transmittance)
        self._image_is_zero = self._transmittance_is_zero = True
        self._project = _ProjectionAdjoint(inputs, options, splats)
        self._runner = CudaGraphRunner(runner.device, runner.stream)

        def differentiate() -> Tensor:
            vector = splats.depths.new_zeros(self.size)
            gathered = self._gathered.of(vector)
            adjoint.add_to(gathered, self._by_image, self._by_transmittance)
            self._features.of(vector).copy_(gathered[:, :channels])
            self._project.launch(self._upstream(vector, self._means2d.of(vector), None), self._results(vector))
            return vector

        with self._runner.on_capture_stream():
            differentiate()
        self._vector = self._runner.capture(None, differentiate)

    def replay(self, by_image: Tensor | None, by_transmittance: Tensor | None) -> Tensor:
        """Return a new vector for the gradients by image and transmittance; None is 0."""
        if by_image is not None:
            self._by_image.copy_(by_image)
        elif not self._image_is_zero:
            self._by_image.zero_()
        if by_transmittance is not None:
            self._by_transmittance.copy_(by_transmittance)
        elif not self._transmittance_is_zero:
            self._by_transmittance.zero_()
        self._image_is_zero, self._transmittance_is_zero = by_image is None, by_transmittance is None
        self._runner.replay()
        return self._vector.clone()

    def by_means2d(self, vector: Tensor) -> Tensor:
        """Return the gradients [N, 2] of a replay's vector by the centres in pixels, a view of it."""
        return self._means2d.of(vector)

    def by_features(self, vector: Tensor) -> Tensor:
        """Return the gradients [N, C] of a replay's vector by the features, a view of it."""
        return self._features.of(vector)

    def by_gaussians(
        self, vector: Tensor | None, by_means2d: Tensor | None, by_depths: Tensor | None, needed: Sequence[bool]
    ) -> list[Tensor | None]:
        """Return the gradients by means, log_scales, quaternions, opacities, pose and lens; None if not needed.

        Args:
            vector: of a replay; None if the image has no gradient.
            by_means2d: all gradients by the centres, of which that of the image is one.
            by_depths: gradients by the depths beside those of the image.
            needed: for each of the results.
        """
        if vector is None or by_means2d is None or by_depths is not None or not self._is_own(by_means2d, vector):
            # Something else depends on the 2D Gaussians.
            of_blend = self._vector.new_zeros(self.size) if vector is None else vector
            vector = torch.zeros_like(of_blend)
            upstream = self._upstream(of_blend, kernel_layout(by_means2d), by_depths)
            self._project.launch_fixed(upstream, self._results(vector))
        return [slot.of(vector) if need else None for slot, need in zip(self._slots, needed, strict=True)]

    def _is_own(self, by_means2d: Tensor, vector: Tensor) -> bool:
        return by_means2d.data_ptr() == vector.data_ptr() + self._means2d.start * vector.element_size()

    def _results(self, vector: Tensor) -> list[Tensor]:
        return [slot.of(vector) for slot in self._slots]

    def _upstream(self, vector: Tensor, by_means2d: Tensor | None, by_depths: Tensor | None) -> list[Tensor | None]:
        """Return the gradients by means2d, conics, depths and opacities."""
        depths = self._depths.of(vector) if self._depth else None
        if by_depths is not None:
            depths = by_depths if depths is None else depths + by_depths
        return [by_means2d, self._conics.of(vector), depths, self._opacities.of(vector)]


def _slots(shapes: Sequence[Sequence[int]]) -> list[_Slot]:
    """Return places one after the other, each at a multiple of 64 numbers, as memory of its own would be."""
    slots, start = [], 0
    for shape in shapes:
        strides = [1] * len(shape)
        for axis in range(len(shape) - 2, -1, -1):
            strides[axis] = strides[axis + 1] * shape[axis + 1]
        slots.append(_Slot(start, tuple(shape), tuple(strides)))
        start += -(-shape[0] * strides[0] // 64) * 64
    return slots


class _ProjectionAdjoint:
    """The adjoint of _project() on fixed memory, but for the gradients themselves."""

    def __init__(self, inputs: Sequence[Tensor], options: RenderOptions, splats: Splats) -> None:
        gaussians = [tensor for place, tensor in enumerate(inputs) if place != FEATURES]
        forward = splats.means2d, splats.conics, splats.depths, splats.opacities
        self._kernel = projection_kernel(warp_scalar(splats.depths.dtype), options.antialiased)
        self._parameters = options.width, options.height, options.near_plane, options.eps2d, options.alpha_threshold
        self._arguments = *gaussians, *self._parameters, splats.extents, *(None,) * (len(forward) + 1)
        self._count, self._device = len(splats.depths), splats.depths.device
        rows, whole = [torch.empty_like(t) for t in forward], [torch.empty_like(t) for t in gaussians]
        self._fixed = fixed_launch(
            self._kernel, self._count, *self._arguments, gradients=self._gradients(rows, whole), rows=rows, whole=whole
        )

    def launch(self, upstream: Sequence[Tensor | None], results: Sequence[Tensor]) -> None:
        """Launch, as a capture needs it."""
        launch(self._kernel, self._count, *self._arguments, gradients=self._gradients(upstream, results))

    def launch_fixed(self, upstream: Sequence[Tensor | None], results: Sequence[Tensor]) -> None:
        """Launch in less host time."""
        self._fixed.launch(upstream, results, warp_stream(self._device))

    def _gradients(self, upstream: Sequence[Tensor | None], results: Sequence[Tensor]) -> list[Tensor | None]:
        return [*results, *(None,) * (len(self._parameters) + 1), *upstream, None]
