"""Train on several ranks: rank 0 sends its training to the others, which follow it step by step."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError, SehdrError
from ..runs.checkpoint import Checkpoint
from ..runs.config import Config
from ..runs.open import load_scene_and_log_notes
from ..runs.run import exposure_compensation, field_from_checkpoint
from ..runs.scene_description import describe_scene, scene_difference
from ..runs.values import LoadArguments
from ..scene import Scene
from ..scene.exposure.compensation import ExposureCompensation
from .cost import gain_of_ranks
from .ranks import Ranks
from .trainer import Trainer
from .training_state import TrainingState, load_state, state_of


@dataclass(frozen=True)
class PhotoRequest:
    """Arguments with which the photos of other nodes are read."""

    data: LoadArguments  # Arguments of load_scene() as a run saves them
    options: dict[str, Any]  # Further arguments of load_scene(): response, method, candidates, photo_storage


@dataclass(frozen=True)
class SharedTraining:
    """Values that the other ranks need for the same training; the tensors of its state follow."""

    config: Config  # Options of the training, after the plan
    info: dict[str, Any]  # Response, base time, normalization and exposure compensation, as in run.json
    layout: dict[str, tuple[torch.Size, torch.dtype]]  # Shape and type of each tensor of its TrainingState
    values: dict[str, Any]  # Values of its TrainingState
    scene: dict | None  # Description of the training views, for nodes that read photos themselves; None on one node


def send_training(ranks: Ranks, trainer: Trainer, compensation: ExposureCompensation | None) -> None:
    """Send a training from rank 0 to the others, in the form of a checkpoint.

    Its photos are corrected by `compensation` already.
    """
    if ranks.info.several_nodes and not ranks.photos_are_requested:
        raise SehdrError("ranks on several nodes read their own photos: train by the command line")
    state = state_of(trainer)
    tensors = {name: tensor.cpu().contiguous() for name, tensor in state.tensors.items()}
    field = trainer.field
    info = {"response": field.response.to_dict(), "base_time": field.base_time}
    info["normalization"] = field.normalization.to_dict()
    if compensation is not None:
        info["exposure_compensation"] = compensation.to_dict()
    layout = {name: (tensor.shape, tensor.dtype) for name, tensor in tensors.items()}
    scene = _training_part(trainer.scene)
    description = describe_scene(scene) if ranks.info.several_nodes else None
    ranks.broadcast_object(SharedTraining(trainer.config, info, layout, state.values, description))
    ranks.broadcast_arrays(list(tensors.values()))
    ranks.share_photos(scene, _bytes_of(scene))


def several_ranks_notes(trainer: Trainer) -> Iterator[str]:
    """Yield notes about a training on several ranks; none on one."""
    if trainer.ranks is None:
        return
    views, most = trainer.scene.train_views, max(trainer.field.gaussians.count, trainer.strategy.cap_max)
    pixels = sum(view.camera.width * view.camera.height for view in views) // len(views)
    yield gain_of_ranks(trainer.ranks.count, most, pixels, trainer.total, trainer.device)
    yield from trainer.ranks.notes()


def follow_leader(ranks: Ranks, path: str | None = None) -> Trainer:
    """Run the steps of rank 0's training on another rank until it ends; return the trainer.

    `path` says where the photos are on this node; by default they are where they are on that of rank 0.
    """
    reads = ranks.info.node > 0 and ranks.info.leads_node
    scene = None
    if reads:
        request: PhotoRequest = ranks.requested_photos()
        data = request.data if path is None else request.data | {"path": path}
        scene = load_scene_and_log_notes(data, **request.options)
    shared: SharedTraining = ranks.broadcast_object()
    config = shared.config
    tensors = {name: torch.empty(shape, dtype=dtype) for name, (shape, dtype) in shared.layout.items()}
    ranks.broadcast_arrays(list(tensors.values()))
    checkpoint = Checkpoint(Path("rank 0"), tensors, shared.values)
    field = field_from_checkpoint(checkpoint, config, shared.info)
    if scene is not None:
        compensation = exposure_compensation(shared.info)
        scene = _training_part(scene if compensation is None else compensation.normalize_photos(scene, field.response))
        _check_same_photos(ranks, shared, scene)
        ranks.share_photos(scene, _bytes_of(scene))
    else:
        scene = ranks.receive_photos()
    trainer = Trainer(scene, config, field.to(ranks.device), ranks=ranks)
    load_state(trainer, TrainingState(checkpoint.tensors, checkpoint.values))
    del shared, checkpoint, tensors
    for _ in trainer:
        pass
    return trainer


def _training_part(scene: Scene) -> Scene:
    """Return what other ranks need of a scene: its training views and points."""
    return Scene(scene.name, scene.format, scene.train_views, scene.points, scene.point_colors)


def _bytes_of(scene: Scene) -> int:
    """Return about how many bytes the arrays of a scene take."""
    arrays = [scene.points, scene.point_colors]
    for view in scene.views:
        arrays += [view.codes, view.mask, view.hdr, view.light_above_white]
    return sum(array.nbytes + 64 for array in arrays if array is not None)


def _check_same_photos(ranks: Ranks, shared: SharedTraining, scene: Scene) -> None:
    """Raise InputError if this node has read other photos than rank 0."""
    assert shared.scene is not None
    name = shared.scene["name"]
    difference = scene_difference(shared.scene, describe_scene(replace(scene, name=name)))
    if difference is not None:
        problem = f"{ranks.info} reads other photos than rank 0: {difference.what} differ"
        raise InputError(scene.name, problem, "copy the same set to all nodes, or use a shared file system")
