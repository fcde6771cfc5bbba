"""One step of Adam over a parameter of any size (kernels/adam.py)."""

import math

import torch
import warp as wp

from ..kernels.adam import adam_update, adam_update_visible, judge_step
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
                f"the {name} is {tensor.dtype} {list(tensor.shape)}, expected contiguous float32 "
                f"{list(parameter.shape)}"
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


@torch.no_grad()
def judge(
    loss: torch.Tensor, norms: torch.Tensor, incomplete: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Three scalars, 1 or 0: whether the loss or a norm is not finite; whether a step is therefore, or as `incomplete`
    is true, to be skipped; whether it is to be made. In one launch, and nothing waits for the device.

    loss: float32 scalar; norms: [K] float32; incomplete: bool scalar. All on one device.
    """
    verdict = norms.new_empty(3)
    empty = torch.empty(0, dtype=torch.bool, device=norms.device)
    with torch_stream(norms.device):
        wp.launch(
            judge_step,
            dim=1,
            inputs=[
                view(loss.detach().reshape(1)),
                view(norms),
                view(empty if incomplete is None else incomplete.reshape(1)),
                view(verdict),
            ],
            device=wp.device_from_torch(norms.device),
            record_tape=False,
        )
    return tuple(verdict.unbind())
