"""Train on several ranks: rank 0 sends its training to the others, which follow it step by step."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..rasterizer.memory import TRAINING_REMEDY, oom_context
from ..runs.checkpoint import Checkpoint
from ..runs.config import Config
from ..runs.run import field_from_checkpoint
from ..scene import Scene
from .initialization import sizes_of
from .machine import interruptible, torch_settings
from .plan import gain_of_ranks
from .ranks import END, GO, WAIT, Ranks
from .trainer import Trainer


@dataclass(frozen=True)
class SharedTraining:
    """Values that the other ranks need for the same training.

    Attributes:
        scene: The scene with its training views.
        config: Options of the training, after the plan.
        info: Response, base time and normalization, as in run.json.
        tensors: Tensors of TrainingState.state(), as arrays.
        values: Values of TrainingState.state().
    """

    scene: Scene
    config: Config
    info: dict[str, Any]
    tensors: dict[str, np.ndarray]
    values: dict[str, Any]


def send_training(ranks: Ranks, scene: Scene, trainer: Trainer) -> None:
    """Send a training from rank 0 to the others, in the form of a checkpoint."""
    tensors, values = trainer.state()
    arrays = {name: tensor.cpu().numpy() for name, tensor in tensors.items()}
    field = trainer.field
    info = {"response": field.response.to_dict(), "base_time": field.base_time}
    info["normalization"] = field.normalization.to_dict()
    scene = Scene(scene.name, scene.format, scene.train_views, scene.points, scene.point_colors)
    photos = [array for view in scene.views for array in (view.codes, view.mask, view.hdr) if array is not None]
    size = sum(array.nbytes + 64 for array in (*photos, *arrays.values(), scene.points, scene.point_colors))
    ranks.broadcast_object(SharedTraining(scene, trainer.config, info, arrays, values), size)


def several_ranks_notes(trainer: Trainer) -> Iterator[str]:
    """Yield notes about a training on several ranks; none on one."""
    if trainer.ranks is None:
        return
    views, most = trainer.scene.train_views, max(trainer.field.gaussians.count, trainer.strategy.cap_max)
    pixels = sum(view.camera.width * view.camera.height for view in views) // len(views)
    yield gain_of_ranks(trainer.ranks.count, most, pixels, trainer.total, trainer.device)
    yield from trainer.ranks.notes()


def follow_leader(ranks: Ranks) -> Trainer:
    """Run the steps of rank 0's training on another rank until it ends; return the trainer."""
    shared: SharedTraining | None = ranks.receive_object()
    if shared is None:
        raise SystemExit(1)
    config, scene = shared.config, shared.scene
    tensors = {name: torch.from_numpy(array) for name, array in shared.tensors.items()}
    checkpoint = Checkpoint(Path("rank 0"), tensors, shared.values)
    field = field_from_checkpoint(checkpoint, config, shared.info).to(ranks.device)
    trainer = Trainer(scene, config, field, ranks=ranks)
    trainer.load_state(checkpoint.tensors, checkpoint.values)
    del shared, checkpoint, tensors

    every = config.scaled(config.schedule.checkpoint_every)
    with (
        oom_context(ranks.device, lambda: sizes_of(scene, trainer.field.gaussians.count), TRAINING_REMEDY),
        torch_settings(config.deterministic),
        interruptible() as interrupted,
    ):
        while (agreed := ranks.all_reduce_min(END if interrupted.is_set() else GO)) != END:
            if agreed == WAIT:
                continue
            trainer.step()
            if trainer.came_to(every):
                trainer.gather()
        trainer.gather()
        ranks.shutdown()  # After rank 0 has saved.
    return trainer
