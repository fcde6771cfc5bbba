"""Train one block: an ordinary training in a run folder of its own, which continues from its newest checkpoint."""

import logging
import platform
import threading
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import SehdrError, as_user_error
from ..runs.run_folder import RunFolder
from ..scene import Scene
from ..subsets import every_nth
from ..training.launch import installed_versions
from .block_plan import BlockPlan
from .division import weights_of

log = logging.getLogger(__name__)

FOLDER = "blocks"  # Folder of the blocks' runs, in that of the merged run
FEWEST_VIEWS = 2  # Photos of a block that must contain a sparse point for the block to start from it
MOST_POINTS = 4  # Sparse points that are looked at, relative to the largest number of Gaussians


class BlockResult(NamedTuple):
    """Result of the training of a block."""

    error: str | None  # One line, if the training cannot be done; None if it is done
    node: str  # Name of the machine that it ran on


def folder_of(out: Path, plan: BlockPlan, index: int) -> Path:
    """Return the run folder of a block."""
    return out / FOLDER / plan.blocks[index].name


def is_finished(folder: Path) -> bool:
    """Return whether the run of a block has been trained to its end, and its confidence measured."""
    run = RunFolder(folder)
    return run.info_file.is_file() and run.confidence.is_file() and bool(run.read_summary().get("finished"))


class StoppedTraining(RuntimeError):
    """A training that was stopped before its end, and has saved."""


def train_block(
    out: Path, index: int, device: str | None, versions: str, is_over: threading.Event | None = None
) -> BlockResult:
    """Train block `index` of the run in the folder `out`, which has blocks.json, or continue its training.

    `versions` are the installed_versions() of the machine that merges the blocks. The training stops and saves when
    `is_over` is set.

    Returns:
        The result. Errors that a user can act on are returned, so that a job that ran differs from one that died.

    Raises:
        StoppedTraining: If the training was stopped by is_over or SIGTERM.
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    try:
        _train(out, index, device, versions, is_over or threading.Event())
    except Exception as error:
        message = as_user_error(error)
        if message is None:
            raise
        return BlockResult(str(message), platform.node())
    return BlockResult(None, platform.node())


def _train(out: Path, index: int, device: str | None, versions: str, is_over: threading.Event) -> None:
    """Train a block; raise SehdrError if this machine has other versions or photos than that which divided the set."""
    from ..training.train import create_trainer

    plan = BlockPlan.read(out)
    block, folder = plan.blocks[index], folder_of(out, plan, index)
    if is_finished(folder):
        return
    if (own := installed_versions()) != versions:
        raise SehdrError(f"it has {own}, and the command was started with {versions}; install the same on both")
    scene = load_block_scene(plan, index)
    plan.check_photos(scene.views)
    data, config = plan.data | {"views": block.views}, plan.config_of(block)
    trainer = create_trainer(scene, folder, config, device=device, resume=True, data=data, shared=plan.shared)
    for _ in trainer:
        if is_over.is_set():
            trainer.stop()
    if trainer.iteration < trainer.total:
        raise StoppedTraining(f"stopped at iteration {trainer.iteration} of {trainer.total}")


def load_block_scene(plan: BlockPlan, index: int) -> Scene:
    """Load the photos of a block, with the response and exposure times of the plan, and the points that they show."""
    names = plan.blocks[index].views
    scene = plan.load_scene(names)
    if missing := [name for name in names if name not in {view.name for view in scene.views}]:
        raise SehdrError(f"{plan.scene}: {missing[0]} of {plan.blocks[index].name} cannot be read any more")
    options = plan.config.response
    chosen_by = scene.chosen_by if scene.light_known else (options.method, tuple(map(str, options.candidates)))
    most = MOST_POINTS * plan.config.densification.cap_max
    points = every_nth(np.arange(len(scene.points)), most)
    positions = scene.points[points]
    counts = np.zeros(len(points), np.int64)
    for view in scene.train_views:
        counts += weights_of(view.camera, positions) > 0
    inside = plan.division.enlarge(index).contains(positions @ plan.axes.T)
    points = points[(counts >= FEWEST_VIEWS) | (inside & (counts > 0))]
    return replace(scene, points=scene.points[points], point_colors=scene.point_colors[points], chosen_by=chosen_by)
