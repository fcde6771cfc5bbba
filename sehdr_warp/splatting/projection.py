"""Stage one of a render: 3D Gaussians to 2D Gaussians."""

import warp as wp
from torch import Tensor

from ..kernels.geometry import matrix, vector
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
) -> tuple[wp.array, wp.array, wp.array, wp.array, wp.array]:
    """The 2D Gaussians of one camera.

    means, log_scales [N, 3]; quaternions [N, 4] (w, x, y, z), any length; opacities [N] in [0, 1];
    world_to_camera [4, 4]; intrinsics [4] (fx, fy, cx, cy) in pixels.

    Returns means2d [N, 2] in pixels, conics [N, 3] (a, b, c of the inverse covariance), depths [N], opacities [N] and
    extents [N, 2], the half-width and half-height in pixels within which alpha reaches alpha_threshold. A culled
    Gaussian has extents 0. All but the extents are differentiable.
    """
    scalar = warp_scalar(means.dtype)
    vec2, vec3, vec4 = vector(2, scalar), vector(3, scalar), vector(4, scalar)
    count = means.shape[0]
    gaussians = (means, vec3), (log_scales, vec3), (quaternions, vec4), (opacities, scalar)
    camera = (world_to_camera, matrix(4, 4, scalar)), (intrinsics, vec4)
    read = [program.read(tensor, kind) for tensor, kind in (*gaussians, *camera)]
    means2d, conics = program.write((count, 2), vec2), program.write((count, 3), vec3)
    depths, opacities2d = program.write((count,), scalar), program.write((count,), scalar)
    results = means2d, conics, depths, opacities2d, program.write((count, 2), vec2, differentiable=False)
    kernel = projection_kernel(scalar, antialiased)
    program.launch(kernel, count, [*read, width, height, near, low_pass, alpha_threshold], results)
    return results
