"""The backward passes of a render that a CUDA graph made: launches that read the graph's memory.

Torch runs backward passes on a thread of their own, whose caches are cold: there an operation of torch takes several
times as long as in the forward pass. So the forward pass allocates the gradients and makes their views.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ...kernels.blend_cuda_backward import copy_features_kernel
from ...kernels.project import projection_kernel
from ..blending_cuda import BlockBackward
from ..projection import ProjectedGaussians, adjoint_arguments, expand_to_gaussians, projection_parameters
from ..render_options import RenderOptions
from ..warp_launch.launching import FixedLaunch, fixed_launch, warp_scalar, warp_stream


class _View(NamedTuple):
    """Layout of a tensor within a longer one, as as_strided() takes it."""

    shape: Sequence[int]
    strides: Sequence[int]
    begin: int


@dataclass(slots=True)
class GradientMemory:
    """Zeros that a backward pass of blend and projection adds to, and the views of them that it returns.

    of_splats: of features and means2d; if the CUDA graph begins with 2D Gaussians, of features, conics, means2d and
    opacities. Emptied when they are returned, because torch takes a leaf's gradient without a copy only if nothing else
    refers to it.
    of_gaussians: of the projection's inputs but the camera, None where not needed.
    """

    zeros: Tensor
    of_splats: Sequence[Tensor]
    of_gaussians: Sequence[Tensor | None]


class GradientLayout:
    """Views of the gradients of blend and projection in one tensor.

    It begins with a row for each Gaussian, which the blend adds to: features, conic, x, y, opacity, and columns that
    pad the row. Then come a copy of the features' gradient and the gradients of the projection's inputs.

    gaussians: inputs of the projection, None where no gradient is needed; none if the graph begins with 2D Gaussians.
    copies_features: add a contiguous gradient of features, which torch can use as a leaf's without a copy.
    like: a tensor of the shape of all of it that takes no memory, for torch.empty_like().
    own_cameras: shapes of the gradients of pose and intrinsics for each Gaussian, None where not needed. Not part of
    it: a million Gaussians take 80 MB, from CapturedBackward.project() alone.
    """

    def __init__(self, blend: BlockBackward, gaussians: Sequence[Tensor | None], *, copies_features: bool) -> None:
        """Add up the offsets."""
        count, columns, channels = len(blend.features), blend.columns, blend.channels
        self._size = count * columns
        self.conics = _View((count, 3), (columns, 1), channels)
        self.means2d = _View((count, 2), (columns, 1), channels + 3)
        self.opacities = _View((count,), (columns,), channels + 5)
        self.features = _View((count, channels), (columns, 1), 0)
        self.copies_features = copies_features
        if copies_features:
            self.features = self._append(self.features.shape, (channels, 1))
        *gaussians, pose, intrinsics = gaussians or (None, None)
        self.gaussians = [None if like is None else self._append(like.shape, like.stride()) for like in gaussians]
        self.own_cameras = [None if like is None else (count, *like.shape) for like in (pose, intrinsics)]
        self.like = blend.transmittance.new_empty(1).expand(self._size)

    def _append(self, shape: Sequence[int], strides: Sequence[int]) -> _View:
        begin = -(-self._size // 64) * 64  # A multiple of 64 numbers, where memory of its own could begin.
        self._size = begin + torch.Size(shape).numel()
        return _View(shape, strides, begin)


class CapturedBackward:
    """The backward passes of blend and projection.

    gaussians, projected: inputs and outputs of the projection on the graph's memory; no inputs if the graph begins with
    2D Gaussians.

    Attributes:
        conics_opacities: a stand-in for both, without memory: an output of the projection and an input of the blend in
            autograd's graph. Its gradient is GradientMemory.zeros, which has theirs. None if the CUDA graph does not
            project.
    """

    def __init__(
        self,
        layout: GradientLayout,
        blend: BlockBackward,
        gaussians: Sequence[Tensor],
        options: RenderOptions,
        projected: ProjectedGaussians,
    ) -> None:
        """Pack the launches."""
        self._layout, self.conics_opacities = layout, layout.like if gaussians else None
        self._blend, rows = blend.on_fixed_memory()
        self._stream = warp_stream(rows.device)  # Torch differentiates on the stream of the forward pass.
        self._of_splats = [layout.features, layout.means2d]
        if layout.copies_features:
            copy = rows.new_empty(layout.features.shape)
            kernel = copy_features_kernel(warp_scalar(rows.dtype))
            self._copy_features = fixed_launch(kernel, copy.shape, rows, copy, by_address=(rows, copy))
            self._features_offset = layout.features.begin * rows.element_size()
        if gaussians:
            of_projection = layout.conics, layout.opacities, *filter(None, layout.gaussians)
            self._projection_offsets = [view.begin * rows.element_size() for view in of_projection]
            self._project = _fixed_projection_backward(gaussians, layout, options, projected, rows)
        else:
            self._of_splats = [layout.features, layout.conics, layout.means2d, layout.opacities]

    def allocate(self, zeros: Tensor | None = None) -> GradientMemory:
        """Return memory for one backward pass.

        zeros: like GradientLayout.like, which the render's replay wrote; by default new ones.
        """
        if zeros is None:
            zeros = torch.zeros_like(self._layout.like)
        of_splats = [zeros.as_strided(*view) for view in self._of_splats]
        of_gaussians = [None if view is None else zeros.as_strided(*view) for view in self._layout.gaussians]
        return GradientMemory(zeros, of_splats, of_gaussians)

    def blend(self, memory: GradientMemory, grad_image: Tensor, grad_transmittance: Tensor | None) -> Sequence[Tensor]:
        """Return GradientMemory.of_splats and, if the graph projects, the gradient of conics_opacities."""
        rows = memory.zeros.data_ptr()
        transmittance = 0 if grad_transmittance is None else grad_transmittance.data_ptr()
        self._blend.launch((), (grad_image.data_ptr(), transmittance, rows), self._stream)
        if self._layout.copies_features:
            self._copy_features.launch((), (rows, rows + self._features_offset), self._stream)
        gradients, memory.of_splats = memory.of_splats, ()
        return gradients if self.conics_opacities is None else (*gradients, memory.zeros)

    def project(
        self, memory: GradientMemory, grad_means2d: Tensor | None, grad_depths: Tensor | None
    ) -> Sequence[Tensor | None]:
        """Return the gradients of the projection's inputs.

        memory: of the blend's backward pass, or if the image has no gradient, a new one.
        """
        begin = memory.zeros.data_ptr()
        shapes = self._layout.own_cameras
        own_cameras = [None if shape is None else memory.zeros.new_zeros(shape) for shape in shapes]
        addresses = [begin + offset for offset in self._projection_offsets]
        addresses += [rows.data_ptr() for rows in own_cameras if rows is not None]
        self._project.launch((grad_means2d, grad_depths), addresses, self._stream)
        return *memory.of_gaussians, *(None if rows is None else rows.sum(0) for rows in own_cameras)


def _fixed_projection_backward(
    gaussians: Sequence[Tensor],
    layout: GradientLayout,
    options: RenderOptions,
    projected: ProjectedGaussians,
    rows: Tensor,
) -> FixedLaunch:
    """Return the launch of a projection's adjoint on the same inputs and extents, for any gradients.

    rows: like the gradients for each Gaussian, which hold those of conics and opacities.
    """
    grad_means2d, grad_depths = torch.empty_like(projected.means2d), torch.empty_like(projected.depths)
    grad_conics, grad_opacities = rows.as_strided(*layout.conics), rows.as_strided(*layout.opacities)
    shapes = *(None if view is None else view.shape for view in layout.gaussians), *layout.own_cameras
    results = [None if shape is None else rows.new_empty(shape) for shape in shapes]
    own_cameras = any(layout.own_cameras)
    gaussians = expand_to_gaussians(gaussians) if own_cameras else gaussians
    kernel = projection_kernel(warp_scalar(projected.depths.dtype), options.antialiased, False, own_cameras)
    upstream = grad_means2d, grad_conics, grad_depths, grad_opacities, None
    parameters = projection_parameters(options)
    arguments, gradients = adjoint_arguments(gaussians, parameters, projected.extents, upstream, results)
    return fixed_launch(
        kernel,
        len(projected.depths),
        *arguments,
        gradients=gradients,
        strided=(grad_means2d, grad_depths),
        by_address=(grad_conics, grad_opacities, *(result for result in results if result is not None)),
    )
