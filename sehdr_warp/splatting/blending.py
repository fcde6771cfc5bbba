"""The last stage of a render: blend the tile lists front to back, any number of channels in one pass."""

import torch
import warp as wp

from .blend_style import DEFAULT_STYLE, BlendStyle
from .blending_cpu import blend_on_cpu
from .blending_cuda import blend_on_cuda
from .bridge import torch_stream
from .tile_lists import TileLists, pack_records


def blend(
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
    style: BlendStyle = DEFAULT_STYLE,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blend features [N, C] over the tile lists: image [H, W, C] and the transmittance left [H, W].

    Differentiable once with respect to means2d [N, 2], conics [N, 3], opacities [N] and features. Which entries count
    is decided by the lists and by alpha_threshold, and taken as given in the derivative.

    records: pack_records()'s of these means2d, conics, opacities and extents, and of alpha_threshold. They are as large
    as what they are made of, so the backward pass makes them again instead of keeping them.
    style: what trades accuracy for speed beside the threshold.
    """
    backend = blend_on_cuda if features.device.type == "cuda" else blend_on_cpu
    options = lists, records, width, height, alpha_threshold, style
    return _Blend.apply(means2d, conics, opacities, features, extents, backend, *options)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, means2d, conics, opacities, features, extents, backend, lists, records, width, height, threshold, style
    ):
        features = features.detach()
        image = features.new_empty(height, width, features.shape[1])
        transmittance = features.new_empty(height, width)
        device = wp.device_from_torch(features.device)
        with torch_stream(features.device):
            # Not the tensors that torch makes results of: the adjoint keeps one, and with it would keep itself.
            results = image.detach(), transmittance.detach()
            ctx.adjoint = backend(device, features, lists, records, *results, threshold, style)
        ctx.save_for_backward(means2d, conics, opacities, extents)
        ctx.sizes, ctx.threshold = (height, width, features.shape[1]), threshold
        ctx.set_materialize_grads(False)
        return image, transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_image, by_transmittance):
        adjoint, ctx.adjoint = ctx.adjoint, None
        if adjoint is None:
            raise RuntimeError("this blend was already differentiated once; run its forward pass again")
        means2d, conics, opacities, extents = ctx.saved_tensors
        height, width, channels = ctx.sizes
        by_image = means2d.new_zeros(ctx.sizes) if by_image is None else by_image.contiguous()
        # Of an axis of length 1 torch calls any stride contiguous, and kernels do not.
        by_image = by_image.as_strided(ctx.sizes, (width * channels, channels, 1))
        if by_transmittance is None:
            by_transmittance = means2d.new_zeros(height, width)
        with torch_stream(means2d.device):
            # [N, C + 6]: by feature, conic a b c, x, y, opacity.
            gathered = adjoint(
                pack_records(means2d, conics, opacities, extents, ctx.threshold),
                by_image,
                by_transmittance.contiguous(),
            )
        by_features, by_conics, by_means2d, by_opacities = gathered.split((channels, 3, 2, 1), dim=1)
        gradients = by_means2d, by_conics, by_opacities[:, 0], by_features
        wanted = (part if needed else None for part, needed in zip(gradients, ctx.needs_input_grad, strict=False))
        return *wanted, *(None,) * 8
