"""Stage one of a render: 3D Gaussians to 2D Gaussians."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels.project import projection_kernel
from .bridge import kernel_layout, zero_gradients
from .warp_launch.launching import launch, warp_scalar
from .warp_launch.threads import whole


def project(
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    *,
    width: int,
    height: int,
    near_plane: float,
    eps2d: float,
    alpha_threshold: float,
    antialiased: bool,
) -> tuple[Tensor, ...]:
    """The 2D Gaussians of one camera.

    means, log_scales [N, 3]; quaternions [N, 4] (w, x, y, z), any length; opacities [N] in [0, 1];
    world_to_camera [4, 4]; intrinsics [4] (fx, fy, cx, cy) in pixels; all contiguous.

    Returns means2d [N, 2] in pixels, conics [N, 3] (a, b, c of the inverse covariance), depths [N], opacities [N] and
    extents [N, 2], the half-width and half-height in pixels within which alpha reaches alpha_threshold. A culled
    Gaussian has extents 0. All but the extents are differentiable, once.
    """
    given = means, log_scales, quaternions, opacities, world_to_camera, intrinsics
    kernel = projection_kernel(warp_scalar(means.dtype), antialiased)
    task = _Task(kernel, (width, height, near_plane, eps2d, alpha_threshold))
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given):
        return _Projection.apply(task, *given)
    return task.run(given)


class _Task(NamedTuple):
    """A projection but for its tensors: the kernel, and the numbers that it takes between tensors read and written."""

    kernel: Any
    numbers: tuple

    def run(self, given: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        means, count = given[0], given[0].shape[0]
        results = tuple(means.new_empty(shape) for shape in ((count, 2), (count, 3), count, count, (count, 2)))
        launch(self.kernel, count, *given, *self.numbers, *results)
        return results


class _Projection(torch.autograd.Function):
    """By hand what bridge.differentiable() makes of a program: half the host's time, which is most of a small picture's
    where rasterize() is called by itself."""

    @staticmethod
    def forward(ctx, task: _Task, *given: Tensor):
        results = task.run(given)
        ctx.task, ctx.given = task, tuple(tensor.detach() for tensor in given)
        ctx.leaves = [tensor.is_leaf for tensor in given]
        ctx.mark_non_differentiable(results[-1])
        ctx.set_materialize_grads(False)
        return results

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *upstream):
        given, ctx.given, needed = ctx.given, None, ctx.needs_input_grad[1:]
        if given is None:
            raise RuntimeError("this projection was already differentiated once; run its forward pass again")
        kernel, numbers = ctx.task
        made = zero_gradients(given, needed, ctx.leaves)
        count, unread = given[0].shape[0], (None,) * len(upstream)
        gradients = *made, *(None,) * len(numbers), *map(kernel_layout, upstream)
        # All Gaussians add to the camera's gradients: on the CPU one thread must.
        alone = whole(count) if any(needed[4:]) else None
        launch(kernel, count, *given, *numbers, *unread, gradients=gradients, ranges=alone)
        return None, *made
