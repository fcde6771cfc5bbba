"""One render as a CUDA graph on memory of its own, and its backward passes."""

import ctypes
import os
import time
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from ...kernels.caller_memory import write_last
from ...kernels.project import projection_kernel
from ..blending_cuda import BlockBackward, blend_on_cuda, fixed_blend_blocks
from ..projection import GaussiansAndCamera, ProjectedGaussians, Splats2D, project_to_camera, projection_parameters
from ..render_options import MAX_INTERSECTIONS, RenderOptions
from ..tile_lists import (
    MAX_SINGLE_SORT,
    EmitOrder,
    PackedSplats,
    TileLists,
    build_tile_lists,
    fixed_pack_splats,
    order_gaussians,
    pack_splats,
)
from ..warp_launch.launching import FixedLaunch, fixed_launch, launch, warp_scalar, warp_stream
from .caller_memory import CallerMemory
from .captured_backward import CapturedBackward, GradientLayout, GradientMemory
from .runner import CudaGraphRunner

MAX_COPIED_GAUSSIANS = MAX_SINGLE_SORT
"""More of them, without a backward pass, are read where they are, and the image is written where it stays."""
SPINS = 200  # Looks at the number of intersections before other threads may run in between, and from query to query.
HEADROOM = 1.25  # Memory for intersections, as a multiple of those of the captured call.
MIN_INTERSECTIONS = 1 << 12
# On Linux time.sleep(0) takes 50 us, to which timers are rounded up.
_let_other_threads_run: Callable[[], object] = getattr(os, "sched_yield", partial(time.sleep, 0))
Outputs = tuple[Tensor, Tensor, Sequence[Tensor], GradientMemory | None]


class RenderGraph:
    """One render on fixed memory as a CUDA graph, which also copies the number of intersections to the host.

    The graph copies inputs in and results out, see CallerMemory. With many Gaussians and without gradients these copies
    would take a sixth of the time: what reads inputs and what writes the image is then launched on the caller's memory,
    before and after the graph.

    Attributes:
        max_intersections: that there is memory for.
        backward: the backward passes; None unless differentiable.
    """

    def __init__(
        self, tensors: GaussiansAndCamera | Splats2D, options: RenderOptions, intersections: int, differentiable: bool
    ) -> None:
        """Launch the render once, then capture it.

        intersections: the least number to allocate memory for. differentiable: whether gradients are needed.
        """
        projects, many = isinstance(tensors, GaussiansAndCamera), len(tensors[0]) > MAX_COPIED_GAUSSIANS
        self._options, self._are_contiguous = options, all(tensor.is_contiguous() for tensor in tensors)
        self._copies = differentiable or options.depth or not projects or not many
        self._inputs = [tensor.detach().contiguous() for tensor in tensors]
        if self._copies:
            self._inputs = [tensor.clone() for tensor in self._inputs]
        self._to_project = GaussiansAndCamera(*self._inputs) if projects else None
        first, channels = self._inputs[0], tensors.features.shape[1] + (options.depth and projects)
        self._image = first.new_empty(options.height, options.width, channels)
        self._transmittance = first.new_empty(options.height, options.width)
        self._counter = torch.empty(1, dtype=torch.int64, device="cpu", pin_memory=True)
        self._count = ctypes.c_int64.from_address(self._counter.data_ptr())
        self._stream = torch.cuda.current_stream(first.device)
        self._runner, self._callers = CudaGraphRunner(first.device), CallerMemory(first.device)
        self.backward: CapturedBackward | None = None

        # Launched once: nothing may be compiled or loaded during a capture, and it tells how much memory is needed.
        splats, packed = self._project_and_pack()
        with self._runner.on_capture_stream():
            emit_order = self._order_and_count(packed)
            limit = int(HEADROOM * max(intersections, int(emit_order.cumulative_counts[-1])))
            self.max_intersections = min(max(MIN_INTERSECTIONS, limit), MAX_INTERSECTIONS)
            layout = self._layout_for(tensors, self._blend(splats, packed, self._list(packed, emit_order)))
            # With more Gaussians memory is worth more than the host's time.
            self._gradients = layout.like if differentiable and not many else None
            if self._copies:
                self._callers.read(self._inputs)
                self._write(splats)
            del emit_order
        if self._copies:
            del splats, packed  # The captured render has its own.
            splats, blend = self._runner.capture(None, self._render)
            if differentiable:
                gaussians = () if self._to_project is None else self._to_project.without_features
                projected = ProjectedGaussians(*splats[:-1])
                self.backward = CapturedBackward(layout, blend, gaussians, options, projected)
        else:
            lists = self._runner.capture(None, lambda: self._list(packed, self._order_and_count(packed)))
            self._fix_launches(splats, packed, lists)
        self._results = [*([self._image, self._transmittance] if self._copies else ()), *self._projection_of(splats)]
        if not self._copies:
            self._inputs, self._to_project = [], None  # The caller's.

    def _render(self) -> tuple[Splats2D, BlockBackward]:
        """Run all stages, which the methods below are, in their order."""
        self._callers.read(self._inputs)
        splats, packed = self._project_and_pack()
        lists = self._list(packed, self._order_and_count(packed))
        backward = self._blend(splats, packed, lists)
        self._write(splats)
        return splats, backward

    def _project_and_pack(self) -> tuple[Splats2D, PackedSplats]:
        options = self._options
        splats = Splats2D(*self._inputs) if self._to_project is None else _project(self._to_project, options)
        pads = not self._copies or self._image.shape[2] % 4 > 0
        return splats, pack_splats(splats, options.alpha_threshold, options.width, options.height, pads=pads)

    def _order_and_count(self, packed: PackedSplats) -> EmitOrder:
        emit_order = order_gaussians(packed, keep_emit_order=False)
        launch(write_last, 1, emit_order.cumulative_counts, self._counter)  # What follows waits longer for a copy.
        return emit_order

    def _list(self, packed: PackedSplats, emit_order: EmitOrder) -> TileLists:
        return build_tile_lists(packed, emit_order, self._options.width, self._options.height, self.max_intersections)

    def _blend(self, splats: Splats2D, packed: PackedSplats, lists: TileLists) -> BlockBackward:
        outputs, threshold = (self._image, self._transmittance), self._options.alpha_threshold
        return blend_on_cuda(splats.features, lists, packed, *outputs, threshold, False, keeps_padded=True)

    def _write(self, splats: Splats2D) -> None:
        zeros = 0 if self._gradients is None else self._gradients.numel()
        self._callers.write([self._image, self._transmittance, *self._projection_of(splats)], zeros)

    def _projection_of(self, splats: Splats2D) -> list[Tensor]:
        """Return what a render returns beside image and transmittance."""
        return [splats.extents] if self._to_project is None else [splats.means2d, splats.depths, splats.extents]

    def _layout_for(self, tensors: GaussiansAndCamera | Splats2D, blend: BlockBackward) -> GradientLayout:
        """Return the layout of the gradients that these tensors of a call require."""
        if self._to_project is None or not isinstance(tensors, GaussiansAndCamera):
            return GradientLayout(blend, [], copies_features=_is_trained(tensors.features))
        inputs = zip(tensors.without_features, self._to_project.without_features, strict=True)
        gaussians = [like if tensor.requires_grad else None for tensor, like in inputs]
        # Features with depths get their gradient through torch.cat().
        copies_features = _is_trained(tensors.features) and not self._options.depth
        return GradientLayout(blend, gaussians, copies_features=copies_features)

    def _fix_launches(self, splats: Splats2D, packed: PackedSplats, lists: TileLists) -> None:
        """Prepare the launches of _launch()."""
        assert packed.padded is not None and self._to_project is not None
        options, outputs = self._options, (self._image, self._transmittance)
        size = options.width, options.height
        self._project = _fixed_projection(self._to_project, options, ProjectedGaussians(*splats[:-1]))
        self._pack = fixed_pack_splats(splats, packed, options.alpha_threshold, *size)
        self._fixed_blend = fixed_blend_blocks(packed.padded, lists, packed, *outputs, options.alpha_threshold)

    def replay(self, tensors: Sequence[Tensor], outputs: Sequence[Tensor] = ()) -> Outputs:
        """Render; return image, transmittance, what follows, and memory for gradients unless a backward pass makes it.

        Means2d, depths and extents follow; the extents alone if the graph begins with 2D Gaussians. Call
        count_intersections() before the next replay: the GPU has then read the table of addresses.

        outputs: contiguous, to write what follows image and transmittance to. By default they are new tensors.
        """
        if self._count.value < 0:  # The last call ended before its count was read, for example by lack of memory.
            self._stream.synchronize()
        self._count.value = -1
        if not self._copies:
            return self._launch(tensors)
        new = self._results[: len(self._results) - len(outputs)]
        image, transmittance, *others = *map(torch.empty_like, new), *outputs
        zeros = None if self._gradients is None else torch.empty_like(self._gradients)
        # Copies must live until the graph is launched.
        inputs = tensors if self._are_contiguous else [tensor.contiguous() for tensor in tensors]
        self._callers.set(inputs, (image, transmittance, *others), zeros)
        self._runner.replay()
        # Views of the gradients are made while the GPU renders.
        gradients = None if zeros is None or self.backward is None else self.backward.allocate(zeros)
        return image, transmittance, others, gradients

    def _launch(self, tensors: Sequence[Tensor]) -> Outputs:
        """Do what replay() does without copies of the features and of the image."""
        inputs = GaussiansAndCamera(*(tensor.contiguous() for tensor in tensors))
        stream = warp_stream(inputs.features.device)
        self._project.launch((), [tensor.data_ptr() for tensor in inputs.without_features], stream)
        self._pack.launch((), (inputs.features.data_ptr(),), stream)
        self._runner.replay()
        image, transmittance = torch.empty_like(self._image), torch.empty_like(self._transmittance)
        self._fixed_blend.launch((), (image.data_ptr(), transmittance.data_ptr()), stream)
        others = [torch.empty_like(result) for result in self._results]
        torch._foreach_copy_(others, self._results)  # pyright: ignore[reportPrivateImportUsage]
        return image, transmittance, others, None

    def count_intersections(self) -> int:
        """Wait for the last render's count; return it. Those beyond max_intersections were left out."""
        count, looks = self._count, 0
        while count.value < 0:
            looks += 1
            if looks > SPINS:
                _let_other_threads_run()
            if looks % SPINS == 0 and self._stream.query() and count.value < 0:
                raise RuntimeError("the GPU has not counted the intersections of a render")
        return count.value


def _is_trained(tensor: Tensor) -> bool:
    """Return whether torch keeps the tensor's gradient, and so would copy one that is not contiguous."""
    return tensor.is_leaf and tensor.requires_grad


def _project(tensors: GaussiansAndCamera, options: RenderOptions) -> Splats2D:
    projected, features = project_to_camera(*tensors.without_features, options=options), tensors.features
    if options.depth:
        features = torch.cat([features, projected.depths[:, None]], 1)
    return Splats2D(*projected, features)


def _fixed_projection(
    tensors: GaussiansAndCamera, options: RenderOptions, projected: ProjectedGaussians
) -> FixedLaunch:
    """Return the launch of _project() for any tensors, to the same outputs."""
    gaussians = tensors.without_features
    kernel = projection_kernel(warp_scalar(projected.depths.dtype), options.antialiased, False, False)
    arguments = *gaussians, *projection_parameters(options), None, *projected
    return fixed_launch(kernel, len(projected.depths), *arguments, by_address=gaussians)
