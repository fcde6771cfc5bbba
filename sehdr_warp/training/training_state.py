"""The state of a training, as a checkpoint stores it and as ranks send it to each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ..runs.checkpoint import under
from .optimizer import load_optimizer_tensors, optimizer_tensors

if TYPE_CHECKING:
    from .trainer import Trainer


class TrainingState(NamedTuple):
    """Everything that determines the next step of a training.

    On the CPU a training that continues from it repeats an uninterrupted one bit for bit. No global random state is
    used.

    Attributes:
        tensors: Named tensors.
        values: Plain values.
    """

    tensors: dict[str, Tensor]
    values: dict[str, Any]


def state_of(trainer: Trainer) -> TrainingState:
    """Return the state of a trainer."""
    field = trainer.field
    parts = {
        "gaussians": field.gaussians.tensors(),
        "fusion": {} if field.fusion is None else field.fusion.state_dict(),
        "response": field.response.state_dict() if isinstance(field.response, torch.nn.Module) else {},
        "optimizer": optimizer_tensors(trainer.optimizer, trainer.batch),
        "densification": trainer.strategy.state_dict(field.gaussians.count),
        "average": trainer.average.state_dict(),
    }
    order, remaining = trainer.order.state()
    parts["generators"] = {"order": order, "device": trainer.generator.get_state()}
    tensors = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
    values = {"iteration": trainer.iteration, "order": remaining, "skipped_steps": trainer.skipped_steps}
    return TrainingState(tensors, values)


def load_state(trainer: Trainer, state: TrainingState) -> None:
    """Continue from a state; the Gaussians of the trainer's field must already be those of the state."""
    tensors, values, device = state.tensors, state.values, trainer.device
    load_optimizer_tensors(trainer.optimizer, under(tensors, "optimizer."), trainer.batch)
    statistics = {name: value.to(device) for name, value in under(tensors, "densification.").items()}
    trainer.strategy.load_state_dict(statistics)
    trainer.average.load_state_dict({name: value.to(device) for name, value in under(tensors, "average.").items()})
    if trainer.ranks is not None and not trainer.ranks.leads:  # The sum over the ranks counts them once.
        for total in statistics.values():
            total.zero_()
    generators = under(tensors, "generators.")
    trainer.order.load_state(generators["order"], values["order"])
    if trainer.generator.get_state().numel() == generators["device"].numel():
        trainer.generator.set_state(generators["device"].cpu())
    trainer.iteration = trainer.first_iteration = values["iteration"]
    trainer.capacity.step_counters[0] = values["skipped_steps"]
