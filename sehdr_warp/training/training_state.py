"""The state of a training, as a checkpoint stores it and as ranks send it to each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from ..runs.checkpoint import Checkpoint, part_of
from .gradient_step import OVERFLOWED, SKIPPED
from .optimizer import load_optimizer_tensors, optimizer_tensors
from .scene_facts import PointFacts

if TYPE_CHECKING:
    from .trainer import Trainer


def state_of(trainer: Trainer) -> Checkpoint:
    """Return the state of a trainer; its tensors change with the next step."""
    field = trainer.field
    parts = {
        "gaussians": field.gaussians.tensors(),
        "fusion": {} if field.fusion is None else field.fusion.state_dict(),
        "response": field.response.state_dict() if isinstance(field.response, torch.nn.Module) else {},
        "optimizer": optimizer_tensors(trainer.optimizer, trainer.batch),
        "densification": trainer.strategy.state_dict(field.gaussians.count),
        "average": trainer.average.means,
    }
    if trainer.data_manager.has_measured:
        parts["estimates"] = {f"{i:06d}": each for i, each in enumerate(trainer.data_manager.estimates or [])}
    order, remaining = trainer.sampler.state()
    parts["generators"] = {"order": order, "device": trainer.generator.get_state()}
    tensors = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
    values = {"iteration": trainer.iteration, "seconds": trainer.seconds, "order": remaining}
    values |= {"skipped_steps": trainer.skipped_steps, "overflowed_steps": trainer.overflowed_steps}
    values |= {name: getattr(trainer, name) for name in PointFacts._fields}
    return Checkpoint(tensors, values)


def point_facts_of(state: Checkpoint) -> PointFacts:
    """Return the figures of points in a state; of an earlier version some are None."""
    return PointFacts(*(state.values.get(name) for name in PointFacts._fields))


def load_state(trainer: Trainer, state: Checkpoint) -> None:
    """Continue from a state; the Gaussians of the trainer's field must already be those of the state."""
    tensors, values, device = state.tensors, state.values, trainer.device
    load_optimizer_tensors(trainer.optimizer, part_of(tensors, "optimizer."), trainer.batch)
    statistics = {name: value.to(device) for name, value in part_of(tensors, "densification.").items()}
    trainer.strategy.load_state_dict(statistics)
    # A stretched schedule may start its average later: samples until now are then of other Gaussians.
    average = part_of(tensors, "average.") if values["iteration"] > trainer.average.first else {}
    trainer.average.means = {name: value.to(device) for name, value in average.items()}
    if trainer.ranks is not None and not trainer.ranks.is_main_process:  # The sum over the ranks counts them once.
        for total in statistics.values():
            total.zero_()
    generators = part_of(tensors, "generators.")
    trainer.sampler.load_state(generators["order"], values["order"])
    if trainer.generator.get_state().numel() == generators["device"].numel():
        trainer.generator.set_state(generators["device"].cpu())
    if estimates := part_of(tensors, "estimates."):
        trainer.data_manager.replace_estimates([estimates[name] for name in sorted(estimates)])
    trainer.iteration = trainer.first_iteration = values["iteration"]
    trainer.seconds = values["seconds"]
    trainer.gradient_step.step_counters[SKIPPED] = values["skipped_steps"]
    trainer.gradient_step.step_counters[OVERFLOWED] = values["overflowed_steps"]
