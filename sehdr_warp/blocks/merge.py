"""Merge the trained blocks of a plan into one run.

Inside a block's core, its Gaussians are those of the merged run; those beyond, which its photos show too, are dropped,
because another block has them. Of those inside, the ones that reach far into other blocks are dropped, too: photos
there were not trained on, and a few Gaussians as large as a block can hide all of it. Rows are in an order in which
neighbors in space are neighbors in memory, so that a part of the scene is a few ranges of rows.
"""

import logging
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import InputError
from ..model.confidence import Evidence
from ..model.gaussians import PARAMETER_NAMES
from ..runs.checkpoint import RENDER_TENSORS, Checkpoint
from ..runs.config_files import override_config
from ..runs.run_folder import RunFolder
from ..runs.run_writer import RunWriter, write_confidence
from ..scene.normalization import Normalization
from ..splats.packing import compact_order
from .block_plan import BlockPlan
from .job import folder_of
from .refine import refine_borders

log = logging.getLogger(__name__)

SIGMAS = 3.0  # Radius of a Gaussian, in its largest standard deviations
REACH = 2.0  # Margins of a block within which Gaussians of others may reach into it
MIDDLE = 0.02, 0.98  # Quantiles of the Gaussians in a core between which most of it is


class TrainedBlock(NamedTuple):
    """Parts of a block that go into the merged run."""

    gaussians: dict[str, Tensor]  # Parameters of the Gaussians in its core, in the coordinates of the merged run
    evidence: Evidence  # Of its photos for these
    values: dict[str, Any]  # Plain values of its newest checkpoint
    info: dict[str, Any]  # Its run.json
    views: list[dict[str, Any]]  # Its views as in scene.json
    summary: dict[str, Any]  # Its summary.json


def merge_blocks(out: Path, plan: BlockPlan, device: torch.device) -> RunWriter:
    """Write the merged run of trained blocks, whose borders are refined on `device`, in place of an earlier one.

    Raises InputError if a block is damaged or was trained with other options, or if no Gaussian is in any core.
    """
    blocks = _without_far_reaching([_trained_block(out, plan, index) for index in range(len(plan.blocks))], plan)
    empty = [plan.blocks[index].name for index, block in enumerate(blocks) if not len(block.evidence.weight_sum)]
    if empty:
        log.warning("%s: no Gaussian is in its core; the merged run has nothing there", ", ".join(empty))
    tensors = {name: torch.cat([block.gaussians[name] for block in blocks]) for name in PARAMETER_NAMES}
    if not len(tensors["means"]):
        raise InputError(out, "no Gaussian of any block is in its core", "train again, with --overwrite")
    counts = torch.tensor([len(block.evidence.weight_sum) for block in blocks])
    owners = torch.arange(len(blocks)).repeat_interleave(counts)
    # A CPU refines in reasonable time what CPUs have trained.
    refines = device.type != "cpu" or not any(block.summary.get("peak_gpu_memory_bytes") for block in blocks)
    if refines:
        refine_borders(tensors, owners, out, plan, device)
    else:
        remedy = f"`sehdr-warp train --resume --out {out}` on a machine with one refines them"
        log.warning(
            "borders are not refined, because blocks were trained on a GPU and this machine has none; %s", remedy
        )
    parts = [vars(block.evidence) for block in blocks]
    evidence = Evidence(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]})
    iterations = max(block.values["iteration"] for block in blocks)
    first = RunFolder(folder_of(out, plan, 0)).read_config()
    config = override_config(
        first, {"schedule.iterations": iterations, "densification.cap_max": len(tensors["means"]), "plan.keep": []}
    )
    views = {view["name"]: view for block in blocks for view in block.views}
    description = RunFolder(folder_of(out, plan, 0)).read_scene()
    description |= {"name": plan.scene, "views": [views[name] for name in plan.exposure_times if name in views]}
    info = {name: blocks[0].info[name] for name in ("base_time", "response")}
    info |= {"scene": plan.scene, "data": plan.data, "normalization": plan.normalization.to_dict()}
    info |= {"color_matrix": matrix} if (matrix := blocks[0].info.get("color_matrix")) else {}
    info |= {"exposure_compensation": compensation.to_dict()} if (compensation := plan.shared.compensation) else {}
    if all(block.info.get("up") for block in blocks):  # Each block found its own from its photos.
        direction = np.mean([block.info["up"]["direction"] for block in blocks], axis=0)
        info |= {"up": {"direction": direction.tolist(), "source": blocks[0].info["up"]["source"]}}
    seconds = sum(block.values["seconds"] for block in blocks)
    arrays = {f"gaussians.{name}": tensor for name, tensor in tensors.items()}
    state = Checkpoint(arrays, {"iteration": iterations, "seconds": seconds})
    folder = RunWriter(out)
    folder.lock()
    try:
        folder.replace_run(description, info, config, None, state)
        summary = _summary(blocks, iterations, seconds, len(tensors["means"]))
        folder.write_summary(summary | {"borders_refined": refines})
        assert folder.checkpoint_hash is not None
        write_confidence(folder, evidence, folder.checkpoint_hash)
    finally:
        folder.unlock()
    log.info("merged %d Gaussians of %d blocks", len(tensors["means"]), len(blocks))
    return folder


def _trained_block(out: Path, plan: BlockPlan, index: int) -> TrainedBlock:
    """Read what the merged run takes from a block."""
    folder = RunFolder(folder_of(out, plan, index))
    folder.require()
    checkpoint = folder.newest_checkpoint(RENDER_TENSORS, "continue with --resume")
    info = folder.read_info()
    if info["base_time"] != plan.shared.base_time:
        problem = f"base_time = {info['base_time']}, and the blocks share {plan.shared.base_time}"
        raise InputError(folder.info_file, problem, "remove the folder of this block, and continue with --resume")
    own = Normalization.from_dict(info["normalization"])
    gaussians = {name: checkpoint.tensors[f"gaussians.{name}"] for name in PARAMETER_NAMES}
    points = own.scene_points(gaussians["means"].numpy())
    inside = np.flatnonzero(plan.division.block_of(points) == index)
    points = plan.normalization.points(points[inside]).astype(np.float32)
    order = compact_order(points)
    rows = torch.from_numpy(inside[order])
    gaussians = {name: tensor[rows] for name, tensor in gaussians.items()}
    gaussians["means"] = torch.from_numpy(points[order])
    gaussians["log_scales"] = gaussians["log_scales"] + math.log(own.unit / plan.normalization.unit)
    evidence = folder.read_evidence(checkpoint)
    if evidence is None:
        raise InputError(folder.confidence, "is not of the newest checkpoint", "continue with --resume")
    views = folder.read_scene()["views"]
    return TrainedBlock(gaussians, evidence.rows(rows), checkpoint.values, info, views, folder.read_summary())


def _without_far_reaching(blocks: list[TrainedBlock], plan: BlockPlan) -> list[TrainedBlock]:
    """Leave out Gaussians that reach farther into the middle of another block than REACH of its margins."""
    places, radii = [], []
    for block in blocks:
        points = plan.normalization.scene_points(block.gaussians["means"].numpy())
        places.append(points @ plan.axes.T)
        radii.append(SIGMAS * plan.normalization.unit * block.gaussians["log_scales"].amax(1).exp().numpy())
    allowed = REACH * plan.division.margins.max(1)
    boxes = [np.quantile(own, MIDDLE, axis=0) if len(own) else None for own in places]
    remaining, dropped = [], 0
    for index, block in enumerate(blocks):
        reaches = np.zeros(len(places[index]), bool)
        large = np.flatnonzero(radii[index] > allowed.min())
        for other, box in enumerate(boxes):
            if other == index or box is None:
                continue
            own = places[index][large]
            distance = np.linalg.norm(np.maximum(np.maximum(box[0] - own, own - box[1]), 0), axis=1)
            reaches[large] |= radii[index][large] - distance > allowed[other]
        dropped += int(reaches.sum())
        rows = torch.from_numpy(np.flatnonzero(~reaches))
        gaussians = {name: tensor[rows] for name, tensor in block.gaussians.items()}
        remaining.append(block._replace(gaussians=gaussians, evidence=block.evidence.rows(rows)))
    if dropped:
        log.info("left out %d Gaussians that reach far into blocks that were trained without them", dropped)
    return remaining


def _summary(blocks: list[TrainedBlock], iterations: int, seconds: float, gaussians: int) -> dict[str, Any]:
    """Return the values of summary.json: times are sums over the blocks, memory is that of the largest."""
    summary: dict[str, Any] = {
        "iteration": iterations,
        "finished": True,
        "train_seconds": round(seconds, 3),
        "gaussians": gaussians,
        "skipped_steps": sum(block.summary.get("skipped_steps", 0) for block in blocks),
        "device": blocks[0].summary.get("device", ""),
        "blocks": [
            {"gaussians": len(block.evidence.weight_sum)}
            | {
                name: block.summary.get(name)
                for name in ("train_seconds", "peak_memory_bytes", "peak_gpu_memory_bytes")
            }
            for block in blocks
        ],
    }
    for name in ("peak_memory_bytes", "peak_gpu_memory_bytes"):
        if peaks := [peak for block in blocks if (peak := block.summary.get(name))]:
            summary[name] = max(peaks)
    return summary
