"""A training on several ranks, as those that do not lead see it: steps, and whatever rank 0 tells."""

from collections.abc import Iterator
from pathlib import Path

import torch

from ..model.radiance_field import RadianceField
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


def hand_on(ranks: Ranks, scene: Scene, trainer: Trainer) -> None:
    """From rank 0: gives the others what they need for the same training, by the way that a checkpoint goes."""
    tensors, values = trainer.state()
    tensors = {name: tensor.cpu().numpy() for name, tensor in tensors.items()}
    info = {"response": trainer.field.response.to_dict(), "base_time": trainer.field.base_time}
    seen = Scene(scene.name, scene.format, scene.train_views, scene.points, scene.point_colors)
    arrays = [array for view in seen.views for array in (view.codes, view.mask, view.hdr) if array is not None]
    size = sum(array.nbytes + 64 for array in (*arrays, *tensors.values(), scene.points, scene.point_colors))
    ranks.share((seen, trainer.config, info, tensors, values), size)


def told_of_ranks(scene: Scene, trainer: Trainer) -> Iterator[str]:
    """What to know of a training on several ranks; nothing of another."""
    if trainer.ranks is None:
        return
    views, most = scene.train_views, max(trainer.field.gaussians.count, trainer.densification.most)
    pixels = sum(view.camera.width * view.camera.height for view in views) // len(views)
    yield gain_of_ranks(trainer.ranks.count, most, pixels, trainer.config.schedule.iterations, trainer.device)
    yield from trainer.ranks.notes()


def follow_leader(ranks: Ranks) -> Trainer:
    """Steps of the training that rank 0 hands on, until all ranks end it; the trainer then."""
    given = ranks.shared()
    if given is None:
        raise SystemExit(1)
    scene, config, info, arrays, values = given
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    checkpoint = Checkpoint(Path("rank 0"), tensors, values)
    del given, arrays
    trainer = _trainer(ranks, scene, config, field_from_checkpoint(checkpoint, config, info), checkpoint)
    del checkpoint, tensors

    every = config.scaled(config.schedule.checkpoint_every)
    with (
        oom_context(ranks.device, lambda: sizes_of(scene, trainer.field.gaussians.count), TRAINING_REMEDY),
        torch_settings(config.deterministic),
        interruptible() as interrupted,
    ):
        while (agreed := ranks.agree(END if interrupted.is_set() else GO)) != END:
            if agreed == WAIT:
                continue
            trainer.step()
            if trainer.came_to(every):
                trainer.settle()
        trainer.settle()
        ranks.part()  # Rank 0 has saved.
    return trainer


def _trainer(ranks: Ranks, scene: Scene, config: Config, field: RadianceField, checkpoint: Checkpoint) -> Trainer:
    trainer = Trainer(scene, config, field.to(ranks.device), ranks=ranks)
    trainer.load_state(checkpoint.tensors, checkpoint.values)
    return trainer
