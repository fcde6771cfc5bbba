"""Refine the borders of merged blocks: Gaussians near them train on, beside those of the other blocks.

Blocks are trained apart, so a surface that crosses a border consists of two halves that never were in one photo
together. Block after block, the last part of its training is repeated in the merged scene: its Gaussians near a border
are trained on its photos, and all others that these photos show are rendered, but stay as they are. That takes about
the memory of the block's own training, however large the merged scene is.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..model.gaussians import Gaussians
from ..model.paged_field import boxes_around, boxes_in_view
from ..runs.config_files import override_config
from ..runs.field import assemble_field
from ..runs.run_folder import RunFolder
from ..scene import Camera, Scene
from ..training.initialization import response_for_training
from ..training.trainer import Trainer
from .block_plan import BlockPlan
from .job import folder_of, load_block_scene

log = logging.getLogger(__name__)

BAND = 1.0  # Distance from a border, in margins of a block, within which its Gaussians are trained
PART = 0.3  # Part of a block's training that is repeated
LEAST_SHARE = 0.02  # Part of the near Gaussians that a photo must show to be trained on
BOX = 256  # Consecutive rows, which are neighbors in space, that are rendered or left out together


def refine_borders(
    tensors: Mapping[str, Tensor], blocks: Tensor, out: Path, plan: BlockPlan, device: torch.device
) -> None:
    """Train the Gaussians near borders, in place.

    `tensors` are the parameters of the N merged Gaussians on the CPU, in the coordinates of the merged run; `blocks`
    [N] the index of the block that each comes from.
    """
    places = plan.normalization.scene_points(tensors["means"].numpy())
    distance = torch.from_numpy(plan.division.border_distance(places))
    for index, block in enumerate(plan.blocks):
        near = (blocks == index) & (distance < BAND * max(block.margin))
        scene = None if not near.any() else _border_photos(plan, index, places[near.numpy()])
        if scene is None:
            continue
        rows, visible = near.nonzero()[:, 0], _visible_rows(tensors, plan, [view.camera for view in scene.train_views])
        around = (visible & ~near).nonzero()[:, 0]
        trainer = _trainer(tensors, rows, around, scene, out, plan, index, device)
        log.info("%s: %d Gaussians near its borders are refined on %d photos", block.name, len(rows), len(scene.views))
        for _ in trainer:
            pass
        for name, values in trainer.field.gaussians.tensors().items():
            tensors[name][rows] = values.cpu()


def _border_photos(plan: BlockPlan, index: int, points: np.ndarray) -> Scene | None:
    """Return the block's scene with the training photos that show points [M, 3] near its borders; None for none."""
    scene = load_block_scene(plan, index)
    views = tuple(
        view
        for view in scene.train_views  # Occlusion is ignored.
        if not view.camera.is_pinhole or view.camera.project(points).inside.mean() >= LEAST_SHARE
    )
    if len(views) < 2:
        return None
    scene = replace(scene, views=views)
    compensation = plan.shared.compensation
    return scene if compensation is None else compensation.normalize_photos(scene, plan.response)


def _visible_rows(tensors: Mapping[str, Tensor], plan: BlockPlan, cameras: list[Camera]) -> Tensor:
    """Return which of the merged Gaussians any of the cameras may see: a bool [N]."""
    low, high = boxes_around(tensors["means"], tensors["log_scales"], BOX)
    visible = np.zeros(len(low), bool)
    for camera in cameras:
        visible |= boxes_in_view(plan.normalization.camera(camera), low, high) if camera.is_pinhole else True
    return torch.from_numpy(visible).repeat_interleave(BOX)[: len(tensors["means"])]


def _trainer(
    tensors: Mapping[str, Tensor],
    rows: Tensor,
    around: Tensor,
    scene: Scene,
    out: Path,
    plan: BlockPlan,
    index: int,
    device: torch.device,
) -> Trainer:
    """Return the trainer of some rows of the merged scene, near the end of the block's training."""
    config = RunFolder(folder_of(out, plan, index)).read_config()
    # A dropout would leave out Gaussians that stay as they are, too: it costs 1 dB near borders.
    still = {"densification.refine_stop_iter": 0, "mcmc.noise_lr": 0.0, "model.dropout": 0.0, "plan.keep": []}
    config = override_config(config, still)
    gaussians = Gaussians(**{name: values[rows] for name, values in tensors.items()})
    response = response_for_training(scene, config)
    field = assemble_field(gaussians, config, response, plan.shared.base_time, plan.normalization)
    trainer = Trainer(scene, config, field.to(device))
    others = {name: values[around].to(device) for name, values in tensors.items()}
    trainer.optimizer.trained_rows = len(rows)
    trainer.field.gaussians.surround(others, trainer.optimizer)
    trainer.iteration = trainer.first_iteration = round((1 - PART) * trainer.total)
    return trainer
