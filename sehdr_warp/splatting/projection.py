"""Stage one of a render: 3D Gaussians to 2D Gaussians."""

from torch import Tensor

from ..kernels.project import projection_kernel
from .bridge import Program, differentiable
from .launching import warp_scalar


@differentiable
def project(
    program: Program,
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    *,
    width: int,
    height: int,
    near: float,
    low_pass: float,
    alpha_threshold: float,
    antialiased: bool,
) -> tuple[Tensor, ...]:
    """The 2D Gaussians of one camera.

    means, log_scales [N, 3]; quaternions [N, 4] (w, x, y, z), any length; opacities [N] in [0, 1];
    world_to_camera [4, 4]; intrinsics [4] (fx, fy, cx, cy) in pixels.

    Returns means2d [N, 2] in pixels, conics [N, 3] (a, b, c of the inverse covariance), depths [N], opacities [N] and
    extents [N, 2], the half-width and half-height in pixels within which alpha reaches alpha_threshold. A culled
    Gaussian has extents 0. All but the extents are differentiable.
    """
    count, dtype = len(means), means.dtype
    extents = program.write((count, 2), dtype, differentiable=False)
    results = *(program.write((count, *shape), dtype) for shape in ((2,), (3,), (), ())), extents
    given = means, log_scales, quaternions, opacities, world_to_camera, intrinsics, width, height
    kernel = projection_kernel(warp_scalar(dtype), antialiased)
    program.launch(kernel, count, [*given, near, low_pass, alpha_threshold], results)
    return results
