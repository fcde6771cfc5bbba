"""One step of Adam over a parameter of any size (kernels/adam.py)."""

import math

import torch
import warp as wp

from ..kernels.adam import adam_update, adam_update_visible
from .arrays import view
from .bridge import torch_stream


@torch.no_grad()
def adam_step(
    parameter: torch.Tensor,
    gradient: torch.Tensor,
    first_moment: torch.Tensor,
    second_moment: torch.Tensor,
    step: torch.Tensor,
    skipped: torch.Tensor,
    *,
    rate: torch.Tensor,
    rate_factor: float,
    betas: tuple[float, float],
    epsilon: float,
    visible: torch.Tensor | None = None,
) -> None:
    """Changes parameter and moments in place, or nothing where `skipped` is 1.

    parameter, gradient, first_moment, second_moment: contiguous float32 of one shape. step, rate, skipped: float32 of
    one element; step is the number of this step, from 1; rate times rate_factor is the learning rate. All on one
    device: nothing waits for it, so that the call can be part of a CUDA graph.
    visible: [N] bool for a parameter [N, ...]: the other rows and their moments stay as they are.
    Raises ValueError for a tensor that is not contiguous float32 of the parameter's shape.
    """
    for name, tensor in {"gradient": gradient, "first moment": first_moment, "second moment": second_moment}.items():
        if tensor.shape != parameter.shape or tensor.dtype != torch.float32 or not tensor.is_contiguous():
            raise ValueError(
                f"the {name} is {tensor.dtype} {list(tensor.shape)}, expected contiguous float32 {list(parameter.shape)}"
            )
    if not parameter.numel():
        return
    if visible is not None and visible.shape != parameter.shape[:1]:
        raise ValueError(f"visible has shape {tuple(visible.shape)}, expected {tuple(parameter.shape[:1])}")
    first_decay, second_decay = betas
    rows = [] if visible is None else [view(visible), parameter.numel() // parameter.shape[0]]
    with torch_stream(parameter.device):
        wp.launch(
            adam_update if visible is None else adam_update_visible,
            dim=parameter.numel(),
            inputs=[
                view(gradient.view(-1)),
                view(step.view(1)),
                view(rate.view(1)),
                view(skipped.view(1)),
                *rows,
                rate_factor,
                1 - first_decay,
                1 - second_decay,
                math.log(first_decay),
                math.log(second_decay),
                epsilon,
                view(parameter.view(-1)),
                view(first_moment.view(-1)),
                view(second_moment.view(-1)),
            ],
            device=wp.device_from_torch(parameter.device),
            record_tape=False,
        )
