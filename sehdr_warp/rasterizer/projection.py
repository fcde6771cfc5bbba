"""Stage one of a render: 3D Gaussians to 2D Gaussians."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels.constants import FRUSTUM_MARGIN as FRUSTUM_MARGIN
from ..kernels.project import projection_kernel
from .gradients import kernel_layout, zero_gradients
from .render_options import RenderOptions
from .torch_contract import direct_apply, keeps_graph, once_differentiable
from .warp_launch.launching import launch, warp_scalar
from .warp_launch.threads import single_range


class ProjectedGaussians(NamedTuple):
    """2D Gaussians of one camera. A culled Gaussian has extents 0 and no gradient.

    Attributes:
        means2d: [N, 2] centers in pixels.
        conics: [N, 3] a, b, c of the inverse covariance, in 1 / square pixels.
        depths: [N] along the camera's axis, in scene units.
        opacities: [N], lowered if antialiased.
        extents: [N, 2] half-width and half-height in pixels within which alpha reaches the threshold.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    extents: Tensor


class RasterInputs(NamedTuple):
    """2D Gaussians with features [N, C], as the stages after projection read them: contiguous."""

    projected: ProjectedGaussians
    features: Tensor


def project_to_camera(
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    options: RenderOptions,
    *,
    differentiate_compensation: bool = False,
) -> ProjectedGaussians:
    """Project Gaussians to the image plane of one camera; all but the extents are differentiable.

    Args:
        means: [N, 3].
        log_scales: [N, 3].
        quaternions: [N, 4] (w, x, y, z), of any length.
        opacities: [N].
        world_to_camera: [4, 4].
        intrinsics: [4] fx, fy, cx, cy in pixels.
        options: of the image; extents end where alpha falls to options.alpha_threshold.
        differentiate_compensation: differentiate the factor of antialiased opacities with respect to the covariance.
    """
    count = means.shape[0]
    outputs = ProjectedGaussians(
        means.new_empty(count, 2),
        means.new_empty(count, 3),
        means.new_empty(count),
        means.new_empty(count),
        means.new_empty(count, 2),
    )
    antialiased = options.antialiased
    kernel = projection_kernel(warp_scalar(means.dtype), antialiased, differentiate_compensation and antialiased)
    tensors = means, log_scales, quaternions, opacities, world_to_camera, intrinsics
    inputs = tuple(tensor.contiguous() for tensor in tensors)
    return ProjectedGaussians(*launch_projection(kernel, inputs, projection_parameters(options), outputs))


def projection_parameters(options: RenderOptions) -> tuple:
    """Return the parameters of the projection kernel that are not tensors, in its order."""
    return options.width, options.height, options.near_plane, options.eps2d, options.alpha_threshold


Gradients = Sequence[Tensor | None]
ProjectionAdjoint = Callable[[Sequence[Tensor], Tensor, Gradients, Sequence[bool]], Gradients]
"""Takes the inputs, the last output, a gradient for each output (None for 0), and which inputs need one; returns a
gradient for each input, None where none is needed."""


def launch_projection(
    kernel: Any, inputs: tuple[Tensor, ...], parameters: tuple, outputs: tuple[Tensor, ...]
) -> tuple[Tensor, ...]:
    """Fill the outputs by a projection kernel, one thread for each Gaussian, and return them, differentiable if needed.

    Does what bridge.differentiable() would, at half of its host time.

    Args:
        kernel: takes inputs, parameters, the last output (None in the forward pass), and outputs.
        inputs: four tensors with a row for each Gaussian, then those that all share (the camera).
        parameters: that are not tensors.
        outputs: with a row for each Gaussian. The last one is 0 if a Gaussian is culled, and not differentiable.
    """
    count = inputs[0].shape[0]

    def project() -> tuple[Tensor, ...]:
        arguments = *inputs, *parameters, None, *outputs
        launch(kernel, count, *arguments)
        return outputs

    def adjoint(inputs: Sequence[Tensor], culling: Tensor, upstream: Gradients, needed: Sequence[bool]) -> Gradients:
        results = zero_gradients(inputs, needed, [tensor.is_leaf for tensor in inputs])
        arguments, gradients = adjoint_arguments(inputs, parameters, culling, upstream, results)
        # All Gaussians add to the camera's gradients: on the CPU one thread must.
        ranges = single_range(count) if any(needed[4:]) else None
        launch(kernel, count, *arguments, gradients=gradients, ranges=ranges)
        return results

    return with_projection_gradient(inputs, project, adjoint)


def adjoint_arguments(
    inputs: Sequence[Tensor], parameters: tuple, culling: Tensor, upstream: Gradients, results: Gradients
) -> tuple[tuple, tuple]:
    """Return arguments of a projection kernel and, for each, its gradient or None, as launch() takes them.

    See ProjectionAdjoint; results are added to. The adjoint does not read the outputs except the last one, culling.
    """
    arguments = *inputs, *parameters, culling, *(None,) * len(upstream)
    return arguments, (*results, *(None,) * (len(parameters) + 1), *upstream)


def with_projection_gradient(
    inputs: tuple[Tensor, ...], project: Callable[[], tuple[Tensor, ...]], adjoint: ProjectionAdjoint
) -> tuple[Tensor, ...]:
    """Return project(), the outputs of a projection, as differentiable functions of its inputs."""
    return _apply_projection(project, adjoint, *inputs) if torch.is_grad_enabled() else project()


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx, project: Callable[[], tuple[Tensor, ...]], adjoint: ProjectionAdjoint, *inputs: Tensor):
        outputs = project()
        ctx.adjoint = adjoint
        ctx.save_for_backward(*inputs, outputs[-1])
        ctx.mark_non_differentiable(outputs[-1])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream):
        *inputs, culling = ctx.saved_tensors
        adjoint = ctx.adjoint
        if not keeps_graph():
            ctx.adjoint = None
        upstream = [kernel_layout(gradient) for gradient in upstream]
        return None, None, *adjoint(inputs, culling, upstream, ctx.needs_input_grad[2:])


_apply_projection = direct_apply(_Projection)
