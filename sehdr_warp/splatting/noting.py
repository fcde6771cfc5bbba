"""What a training notes of each Gaussian at every step, in one launch (kernels/noting.py)."""

import torch
import warp as wp

from ..kernels.noting import note_gradients
from .arrays import view
from .bridge import torch_stream


@torch.no_grad()
def note_image_gradients(
    gradients: torch.Tensor,
    radii: torch.Tensor,
    usable: torch.Tensor,
    weights: torch.Tensor | None,
    width: int,
    height: int,
    gradient_sum: torch.Tensor,
    seen: torch.Tensor,
) -> None:
    """Adds to gradient_sum [N] the lengths of gradients [N, 2] by the projected centres, in normalised screen units
    (the screen is 2 wide), times weights [N] if given, and to seen [N] 1, where radii [N] are above 0; nothing where
    the scalar usable is 0. width, height: of the image in pixels. All contiguous float32 on one device."""
    if not len(radii):
        return
    with torch_stream(radii.device):
        wp.launch(
            note_gradients,
            dim=len(radii),
            inputs=[
                view(gradients.contiguous(), wp.vec2),
                view(radii),
                view(usable.reshape(1)),
                view(radii[:0] if weights is None else weights),
                width / 2,
                height / 2,
                view(gradient_sum),
                view(seen),
            ],
            device=wp.device_from_torch(radii.device),
            record_tape=False,
        )
