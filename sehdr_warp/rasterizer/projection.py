"""Stage one of a render: project Gaussians to the image. 2D Gaussians with their features are called splats.

Outputs of a projection kernel end with one that is 0 if a Gaussian is culled: the extents, or of rasterize_directions()
the distances. The adjoint reads this one alone, as the argument visibility.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels.constants import FRUSTUM_MARGIN as FRUSTUM_MARGIN  # For compat, which may not import kernels.
from ..kernels.project import projection_kernel
from .gradients import kernel_layout, zero_gradients
from .render_options import RenderOptions
from .torch_contract import direct_apply, keeps_graph, once_differentiable
from .warp_launch.launching import launch, warp_scalar
from .warp_launch.threads import single_range


class GaussiansAndCamera(NamedTuple):
    """The tensors that rasterize() takes, for one camera."""

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacities: Tensor
    features: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor

    @property
    def without_features(self) -> tuple[Tensor, ...]:
        """Return what project_to_camera() takes, in its order: all but the features."""
        return *self[:4], *self[5:]


class ProjectedGaussians(NamedTuple):
    """2D Gaussians of one camera. A culled Gaussian has extents 0 and no gradient."""

    means2d: Tensor  # [N, 2] centers in pixels
    conics: Tensor  # [N, 3] a, b, c of the inverse covariance, in 1 / square pixels
    depths: Tensor  # [N] along the camera's axis, in scene units
    opacities: Tensor  # [N], lowered if antialiased
    extents: Tensor  # [N, 2] half-width and half-height in pixels within which alpha reaches the threshold


class Splats2D(NamedTuple):
    """ProjectedGaussians and their features [N, C], as the stages after projection read them: contiguous."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    extents: Tensor
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
    """Project Gaussians to one camera, tensors as rasterize() takes them; all but the extents are differentiable.

    differentiate_compensation: differentiate the factor of antialiased opacities with respect to the covariance.
    """
    antialiased, own_cameras = options.antialiased, torch_sums_gradients(world_to_camera, intrinsics)
    kinds = antialiased, differentiate_compensation and antialiased, own_cameras
    kernel = projection_kernel(warp_scalar(means.dtype), *kinds)
    tensors = means, log_scales, quaternions, opacities, world_to_camera, intrinsics
    inputs = tuple(tensor.contiguous() for tensor in tensors)
    inputs = expand_to_gaussians(inputs) if own_cameras else inputs
    outputs = [means.new_empty(len(means), *shape) for shape in ((2,), (3,), (), (), (2,))]
    return ProjectedGaussians(*launch_projection(kernel, inputs, projection_parameters(options), outputs))


def torch_sums_gradients(*shared: Tensor) -> bool:
    """Return whether each Gaussian's thread writes its own gradients of tensors that all share, for torch to sum.

    The sums have a fixed order. For a million Gaussians and a camera an H200 takes 0.8 ms, and 19 ms where all threads
    add to the same 20 numbers.
    """
    needed = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in shared)
    return needed and adds_in_any_order(shared[0].device)


def expand_to_gaussians(inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return a projection's inputs, those that all Gaussians share as views with a row for each, without memory."""
    count = len(inputs[0])
    return *inputs[:4], *(tensor.expand(count, *tensor.shape) for tensor in inputs[4:])


def adds_in_any_order(device: torch.device) -> bool:
    """Return whether threads of a device add to one number in any order; tests without a GPU replace this function."""
    return device.type == "cuda"


def projection_parameters(options: RenderOptions) -> tuple:
    """Return the parameters of the projection kernel that are not tensors, in its order."""
    sizes = options.width, options.height, options.near_plane, options.eps2d, options.alpha_threshold
    return *sizes, options.ray_limit_x, options.ray_limit_y


def launch_projection(
    kernel: Any, inputs: Sequence[Tensor], parameters: tuple, outputs: Sequence[Tensor]
) -> Sequence[Tensor]:
    """Fill the outputs by a projection kernel, one thread for each Gaussian; return them, differentiable if needed.

    Does what bridge.differentiable() would, at half of its host time.

    Args:
        kernel: takes inputs, parameters, visibility in the adjoint (else None), and outputs.
        inputs: four tensors with a row for each Gaussian, then those that all share (the camera); contiguous, or of
            expand_to_gaussians().
        parameters: that are not tensors.
        outputs: with a row for each Gaussian; the last one, visibility, is not differentiable.
    """
    count = len(inputs[0])
    arguments = *inputs, *parameters, None, *outputs
    launch(kernel, count, *arguments)

    def backward(
        inputs: Sequence[Tensor], visibility: Tensor, upstream: Sequence[Tensor | None], needed: Sequence[bool]
    ) -> Sequence[Tensor | None]:
        results = zero_gradients(inputs, needed)
        arguments, gradients = adjoint_arguments(inputs, parameters, visibility, upstream, results)
        # All Gaussians add to the camera's gradients: on the CPU one thread must.
        ranges = single_range(count) if any(needed[4:]) else None
        launch(kernel, count, *arguments, gradients=gradients, ranges=ranges)
        return results

    return with_projection_gradient(outputs, inputs, backward)


ProjectionBackward = Callable[
    [Sequence[Tensor], Tensor, Sequence[Tensor | None], Sequence[bool]], Sequence[Tensor | None]
]
"""Takes the inputs, visibility, a gradient for each output (None for 0), and which inputs need one; returns a gradient
for each input, None if none is needed."""


def adjoint_arguments(
    inputs: Sequence[Tensor],
    parameters: tuple,
    visibility: Tensor,
    upstream: Sequence[Tensor | None],
    results: Sequence[Tensor | None],
) -> tuple[tuple, tuple]:
    """Return arguments of a projection kernel and, for each, its gradient or None, as launch() takes them.

    See ProjectionBackward; results are added to.
    """
    arguments = *inputs, *parameters, visibility, *(None,) * len(upstream)
    return arguments, (*results, *(None,) * (len(parameters) + 1), *upstream)


def with_projection_gradient(
    outputs: Sequence[Tensor], inputs: Sequence[Tensor], backward: ProjectionBackward
) -> Sequence[Tensor]:
    """Return the outputs of a projection, all but the last one as differentiable functions of its inputs."""
    if not torch.is_grad_enabled():
        return outputs
    return *_apply_projection(outputs, backward, *inputs), outputs[-1]


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx, outputs: Sequence[Tensor], backward: ProjectionBackward, *inputs: Tensor):
        *differentiable, visibility = outputs
        ctx.gradients_of = backward
        ctx.save_for_backward(*inputs, visibility)
        ctx.set_materialize_grads(False)
        return tuple(differentiable)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream):
        *inputs, visibility = ctx.saved_tensors
        gradients_of = ctx.gradients_of
        if not keeps_graph():
            ctx.gradients_of = None
        upstream = [None if gradient is None else kernel_layout(gradient) for gradient in upstream]
        return None, None, *gradients_of(inputs, visibility, [*upstream, None], ctx.needs_input_grad[2:])


_apply_projection = direct_apply(_Projection)
