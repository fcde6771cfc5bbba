"""The last stage of a render: blend the tile lists front to back, any number of channels in one pass."""

import warp as wp

from .blending_cpu import blend_on_cpu
from .blending_cuda import blend_on_cuda
from .bridge import differentiable
from .tile_lists import TileLists


@differentiable
def blend(
    program,
    means2d,
    conics,
    opacities,
    features,
    *,
    lists: TileLists,
    width: int,
    height: int,
    alpha_threshold: float,
    block_kernels: bool | None = None,
):
    """Blend features [N, C] over the tile lists: image [H, W, C] and alpha [H, W].

    Differentiable with respect to means2d [N, 2], conics [N, 3], opacities [N] and features. Which entries count is
    decided by the lists and by alpha_threshold, and taken as given in the derivative.

    block_kernels: use the CUDA kernels; None means on CUDA only. On the CPU they need wp.config.enable_cpu_blocks and
    serve tests.
    """
    inputs = {
        "means2d": program.read(means2d),
        "conics": program.read(conics),
        "opacities": program.read(opacities),
        "features": program.read(features),
    }
    image = program.write((height, width, features.shape[1]), features.dtype)
    alpha = program.write((height, width), features.dtype)
    on_blocks = not program.is_cpu if block_kernels is None else block_kernels
    backend = blend_on_cuda if on_blocks else blend_on_cpu
    backward = backend(program.device, features, lists, program.tensor(image), program.tensor(alpha), alpha_threshold)

    def adjoint():
        """backward() gives [N, C + 6]: by feature, conic a b c, x, y, opacity."""
        gathered = backward(wp.to_torch(image.grad, requires_grad=False), wp.to_torch(alpha.grad, requires_grad=False))
        channels = features.shape[1]
        columns = {
            "features": gathered[:, :channels],
            "conics": gathered[:, channels : channels + 3],
            "means2d": gathered[:, channels + 3 : channels + 5],
            "opacities": gathered[:, channels + 5],
        }
        for name, gradient in columns.items():
            if inputs[name].grad is not None:
                wp.to_torch(inputs[name].grad, requires_grad=False).add_(gradient)

    program.record_adjoint(adjoint)
    return image, alpha
