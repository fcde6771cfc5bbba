"""The last stage of a render: blend the tile lists front to back, any number of channels in one pass."""

import warp as wp

from .blend_style import DEFAULT_STYLE, BlendStyle
from .blending_cpu import blend_on_cpu
from .blending_cuda import blend_on_cuda
from .bridge import differentiable
from .tile_lists import TileLists, pack_records


@differentiable
def blend(
    program,
    means2d,
    conics,
    opacities,
    features,
    *,
    lists: TileLists,
    records,
    extents,
    width: int,
    height: int,
    alpha_threshold: float,
    block_kernels: bool | None = None,
    style: BlendStyle = DEFAULT_STYLE,
):
    """Blend features [N, C] over the tile lists: image [H, W, C] and the transmittance left [H, W].

    Differentiable with respect to means2d [N, 2], conics [N, 3], opacities [N] and features. Which entries count is
    decided by the lists and by alpha_threshold, and taken as given in the derivative.

    records: pack_records()'s of these means2d, conics, opacities and extents, and of alpha_threshold. They are as large
    as what they are made of, so the backward pass makes them again instead of keeping them.
    block_kernels: use the CUDA kernels; None means on CUDA only. On the CPU they need wp.config.enable_cpu_blocks and
    serve tests. style: what trades accuracy for speed beside the threshold.
    """
    gradients = [program.hand_over(tensor) for tensor in (features, conics, means2d, opacities)]
    channels = features.shape[1]
    image = program.write((height, width, channels), features.dtype)
    transmittance = program.write((height, width), features.dtype)
    on_blocks = not program.is_cpu if block_kernels is None else block_kernels
    backend = blend_on_cuda if on_blocks else blend_on_cpu
    backward = backend(
        program.device,
        features,
        lists,
        records,
        program.tensor(image),
        program.tensor(transmittance),
        alpha_threshold,
        style,
    )

    def adjoint():
        """backward() gives [N, C + 6]: by feature, conic a b c, x, y, opacity."""
        gathered = backward(
            pack_records(means2d, conics, opacities, extents, alpha_threshold),
            wp.to_torch(image.grad, requires_grad=False),
            wp.to_torch(transmittance.grad, requires_grad=False),
        )
        parts = gathered.split((channels, 3, 2, 1), dim=1)
        for gradient, part in zip(gradients, (*parts[:3], parts[3][:, 0]), strict=True):
            gradient.value = part if gradient.wanted else None

    program.record_adjoint(adjoint)
    return image, transmittance
