"""The blend on CUDA block kernels (also on CPU fibers, where tests ask for them)."""

import torch
import warp as wp

from ..kernels import blend_cuda, blend_cuda_adjoint
from ..kernels.geometry import vector
from .arrays import view, warp_scalar
from .blend_style import BlendStyle
from .gathering import gather_by_gaussian
from .tile_lists import TileLists


def blend_on_cuda(
    device, features, lists: TileLists, records, image, transmittance, alpha_threshold: float, style: BlendStyle
):
    """Fill image [H, W, C] and transmittance [H, W]; return the backward pass.

    It takes the records made again and the gradients of both, and gives [N, C + 6]: by feature, conic a b c,
    x, y, opacity.
    """
    scalar = warp_scalar(features.dtype)
    height, width, channels = image.shape
    vec4, pixel = vector(4, scalar), vector(channels, scalar)
    padding = blend_cuda.padded_channels(channels) - channels
    last = torch.empty(height * width, dtype=torch.int32, device=features.device)
    tile_count = lists.columns * lists.rows

    def pixels(tensor):
        return view(tensor.view(-1, channels), dtype=pixel)

    # The backward pass takes the features from here and lets them go once they are padded: again, since what is padded
    # is larger.
    count, kept = len(features), [features]

    def rows_of_four(features, records):
        padded = torch.nn.functional.pad(features, (0, padding)) if padding else features
        return [view(rows, dtype=vec4) for rows in (*records, padded.reshape(-1, 4))]

    def launch(kernel, blocks_per_tile, by_gaussian, arguments):
        wp.launch(
            kernel,
            dim=tile_count * blocks_per_tile * blend_cuda.BLOCK_DIM,
            inputs=[
                view(lists.ranges, dtype=wp.vec2i),
                view(lists.gaussians),
                *by_gaussian,
                lists.columns,
                width,
                height,
                alpha_threshold,
                *arguments,
            ],
            block_dim=blend_cuda.BLOCK_DIM,
            device=device,
            record_tape=False,
        )

    launch(
        blend_cuda.forward_kernel(scalar, channels, style.transmittance_min, style.fast_math),
        blend_cuda.BLOCKS_PER_TILE,
        rows_of_four(features, records),
        [pixels(image), view(transmittance.view(-1)), view(last)],
    )

    def backward(records, image_gradient: torch.Tensor, transmittance_gradient: torch.Tensor) -> torch.Tensor:
        by_gaussian = rows_of_four(kept.pop(), records)
        kernel = blend_cuda_adjoint.backward_kernel(scalar, channels, style.fast_math, style.deterministic)
        corners = blend_cuda_adjoint.BLOCKS_PER_TILE

        def add_gradients(blocks_per_tile, corner, rows_of, gradients):
            launch(
                kernel,
                blocks_per_tile,
                by_gaussian,
                [
                    view(transmittance.view(-1)),
                    view(last),
                    pixels(image_gradient),
                    view(transmittance_gradient.view(-1)),
                    blend_cuda_adjoint.ROWS,
                    channels + 6,
                    corner,
                    view(rows_of),
                    view(gradients.view(-1)),
                ],
            )

        if not style.deterministic:
            gathered = transmittance.new_zeros(count, channels + 6)
            add_gradients(corners, 0, lists.gaussians, gathered)
            return gathered
        by_entry = transmittance.new_zeros(lists.entry_count, channels + 6)
        for corner in range(corners):
            add_gradients(1, corner, lists.emission.places, by_entry)
        return gather_by_gaussian(lists.emission, by_entry)

    return backward
