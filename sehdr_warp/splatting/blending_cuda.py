"""The blend on CUDA block kernels (also on CPU fibers, where tests ask for them)."""

import torch
import warp as wp

from ..kernels import blend_cuda
from ..kernels.geometry import vector
from .dtypes import warp_scalar
from .tile_lists import TileLists


def blend_on_cuda(device, features, lists: TileLists, image, alpha, width: int, height: int, alpha_threshold: float):
    """Fill image [H, W, C] and alpha [H, W] (Warp arrays); return the backward pass as a function of their .grad."""
    scalar = warp_scalar(features.dtype)
    channels = features.shape[1]
    vec4, pixel = vector(4, scalar), vector(channels, scalar)
    padding = blend_cuda.padded_channels(channels) - channels
    padded = torch.nn.functional.pad(features, (0, padding)) if padding else features
    transmittance = features.new_empty(height * width)
    last = torch.empty(height * width, dtype=torch.int32, device=features.device)
    tile_count = lists.columns * lists.rows

    def pixels(array):
        return wp.from_torch(wp.to_torch(array, requires_grad=False).reshape(-1, channels), dtype=pixel)

    def launch(kernel, blocks_per_tile, arguments):
        wp.launch(
            kernel,
            dim=tile_count * blocks_per_tile * blend_cuda.BLOCK_DIM,
            inputs=[
                wp.from_torch(lists.ranges, dtype=wp.vec2i),
                wp.from_torch(lists.gaussians),
                wp.from_torch(lists.shapes, dtype=vec4),
                wp.from_torch(lists.ellipses, dtype=vec4),
                wp.from_torch(padded.reshape(-1, 4), dtype=vec4, requires_grad=False),
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
        blend_cuda.forward_kernel(scalar, channels),
        blend_cuda.FORWARD_BLOCKS_PER_TILE,
        [pixels(image), alpha.flatten(), wp.from_torch(transmittance), wp.from_torch(last)],
    )

    def backward() -> torch.Tensor:
        gathered = features.new_zeros(features.shape[0], channels + 6)
        launch(
            blend_cuda.backward_kernel(scalar, channels),
            blend_cuda.BACKWARD_BLOCKS_PER_TILE,
            [
                wp.from_torch(transmittance),
                wp.from_torch(last),
                pixels(image.grad),
                alpha.grad.flatten(),
                blend_cuda.BACKWARD_ROWS,
                channels + 6,
                wp.from_torch(gathered).flatten(),
            ],
        )
        return gathered

    return backward
