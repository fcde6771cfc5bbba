"""Ranks other than 0: rank 0 sends them its training, and they take the same steps without writing anything."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch

from ..errors import InputError
from ..runs.checkpoint import Checkpoint
from ..runs.config import Config
from ..runs.field import field_from_checkpoint
from ..runs.open import PhotoRequest
from ..runs.run import exposure_compensation
from ..runs.scene_description import SFM_LAYOUTS, describe_scene, in_world_of_run, scene_difference
from ..scene import Camera, Scene
from ..scene.normalization import Normalization
from .cost import gain_of_ranks
from .ranks import Ranks
from .trainer import Trainer
from .training_state import load_state, point_facts_of, state_of


@dataclass(frozen=True)
class TrainingMessage:
    """Message of rank 0 with which the others train alike; the tensors of its state follow."""

    config: Config  # Options of the training, after the plan
    info: dict[str, Any]  # Content of run.json
    layout: dict[str, tuple[torch.Size, torch.dtype]]  # Shape and type of each tensor of its state
    values: dict[str, Any]  # Values of its state
    scene: dict | None  # Description of the training views, for nodes that read photos themselves; None on one node


def send_training(ranks: Ranks, trainer: Trainer, info: dict[str, Any]) -> None:
    """Send a training from rank 0 to the others, in the form of a checkpoint; `info` is the content of its run.json."""
    state = state_of(trainer)
    tensors = {name: tensor.cpu().contiguous() for name, tensor in state.tensors.items()}
    layout = {name: (tensor.shape, tensor.dtype) for name, tensor in tensors.items()}
    scene = _training_part(trainer.scene)
    description = describe_scene(scene) if ranks.info.several_nodes else None
    ranks.broadcast_object(TrainingMessage(trainer.config, info, layout, state.values, description))
    ranks.broadcast_arrays(list(tensors.values()))
    ranks.share_photos(scene, _bytes_of(scene))


def several_ranks_notes(trainer: Trainer) -> Iterator[str]:
    """Yield notes about a training on several ranks; none on one."""
    if trainer.ranks is None:
        return
    views, most = trainer.scene.train_views, max(trainer.field.gaussians.count, trainer.strategy.cap_max)
    pixels = sum(view.camera.pixel_count for view in views) // len(views)
    yield gain_of_ranks(trainer.ranks.count, most, pixels, trainer.total, trainer.device)
    yield from trainer.ranks.notes()


def train_as_worker(ranks: Ranks, path: str | None = None) -> Trainer:
    """Run the steps of rank 0's training on another rank until it ends; return the trainer.

    `path` says where the photos are on this node; by default they are where they are on that of rank 0.
    """
    reads = ranks.info.node > 0 and ranks.info.local_rank == 0
    scene = None
    if reads:
        request: PhotoRequest = ranks.requested_photos()
        scene = replace(request, data=request.data | ({} if path is None else {"path": path})).load()
    message: TrainingMessage = ranks.broadcast_object()
    config = message.config
    tensors = {name: torch.empty(shape, dtype=dtype) for name, (shape, dtype) in message.layout.items()}
    ranks.broadcast_arrays(list(tensors.values()))
    checkpoint = Checkpoint(tensors, message.values)
    field = field_from_checkpoint(checkpoint, config, message.info)
    if scene is not None:
        scene = _in_world_of_rank_0(scene, message)
        compensation = exposure_compensation(message.info)
        scene = _training_part(scene if compensation is None else compensation.normalize_photos(scene, field.response))
        _check_same_photos(ranks, message, scene)
        ranks.share_photos(scene, _bytes_of(scene))
    else:
        scene = ranks.receive_photos()
    trainer = Trainer(scene, config, field.to(ranks.device), ranks=ranks, point_facts=point_facts_of(checkpoint))
    load_state(trainer, checkpoint)
    del message, checkpoint, tensors
    for _ in trainer:
        pass
    return trainer


def _in_world_of_rank_0(scene: Scene, message: TrainingMessage) -> Scene:
    """Return a scene with rank 0's cameras if structure from motion found them: each node may find another world."""
    if scene.format not in SFM_LAYOUTS or message.scene is None:
        return scene
    cameras = {view["name"]: Camera.from_dict(view["camera"]) for view in message.scene["views"]}
    unit = Normalization.from_dict(message.info["normalization"]).unit
    return in_world_of_run(scene, cameras, unit, "rank 0", scene.name)


def _training_part(scene: Scene) -> Scene:
    """Return what other ranks need of a scene: its training views, points and background."""
    background = scene.black_background
    return Scene(
        scene.name, scene.format, scene.train_views, scene.points, scene.point_colors, black_background=background
    )


def _bytes_of(scene: Scene) -> int:
    """Return about how many bytes the arrays of a scene take."""
    arrays = [scene.points, scene.point_colors]
    for view in scene.views:
        arrays += [view.codes, view.mask, view.hdr, view.light_above_white]
    return sum(array.nbytes + 64 for array in arrays if array is not None)


def _check_same_photos(ranks: Ranks, message: TrainingMessage, scene: Scene) -> None:
    """Raise InputError if this node has read other photos than rank 0."""
    assert message.scene is not None
    name = message.scene["name"]
    difference = scene_difference(message.scene, describe_scene(replace(scene, name=name)))
    if difference is not None:
        problem = f"{ranks.info} reads other photos than rank 0: {difference.what} differ"
        raise InputError(scene.name, problem, "copy the same set to all nodes, or use a shared file system")
