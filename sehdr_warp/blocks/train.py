"""Train a set of photos in blocks: plan, jobs, merged run with refined borders, its figures on held-out photos."""

import logging
import math
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import torch

from ..errors import InputError
from ..files import make_parents, refuse_links, writing
from ..runs.config import Config
from ..runs.config_files import require_same_config
from ..runs.run import Run, load_run
from ..runs.run_folder import RunFolder
from ..runs.run_writer import RunWriter
from ..runs.values import LoadArguments
from ..subsets import every_nth
from .block_plan import FILE, BlockPlan, make_block_plan
from .job import FOLDER, folder_of, is_finished
from .jobs import run_blocks
from .merge import merge_blocks
from .seams import SeamErrors, measure_seams

log = logging.getLogger(__name__)

MOST_VIEWS = 200  # Held-out photos that the merged run is measured on


def is_in_blocks(out: Path) -> bool:
    """Return whether a folder holds a training in blocks."""
    return os.path.isfile(out / FILE)


def train_in_blocks(
    data: LoadArguments,
    out: Path,
    config: Config,
    count: int | None,
    *,
    device: torch.device,
    gpus: int = 1,
    slurm: Mapping[str, str] | None = None,
    slurm_device: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> Run | None:
    """Train a set of photos in blocks and merge them into one run.

    Args:
        data: Arguments of load_scene() for the set.
        out: Folder of the merged run; the blocks' runs are in `blocks/` below it.
        config: Options of the training, the same for each block.
        count: Number of blocks; None chooses it.
        device: Device to measure and merge on; blocks train on it and the GPUs that follow it.
        gpus: Blocks to train at once.
        slurm: Parameters of SLURM jobs; None trains on this machine.
        slurm_device: "cpu" for SLURM jobs without a GPU; else each has one, whatever `device` is.
        resume: Continue; finished blocks are not run again.
        overwrite: Replace a training in blocks in `out`.

    Returns:
        The merged run; None if `count` is None and one training is enough for the set.

    Raises:
        InputError: If the folder is in use, the set cannot be divided, or a resumed training differs.
        SehdrError: If blocks could not be trained.
    """
    plan = _continue(out, data, config, count) if _check(out, resume=resume, overwrite=overwrite) else None
    if plan is None:
        plan = make_block_plan(data, config, device, count)
        if plan is None:
            return None
        if overwrite:
            for place in (*out.glob(f"{FOLDER}/block_*"), out / FOLDER / "logs"):
                shutil.rmtree(place, ignore_errors=True)
        with writing(out):
            make_parents(out / FILE)
        plan.write(out)
    if resume and _is_merged(out, plan, device):
        log.info("%s: all blocks are trained and merged", out)
        return load_run(out, device=device)
    run_blocks(out, plan, device=device, gpus=gpus, slurm=slurm, slurm_device=slurm_device)
    folder = merge_blocks(out, plan, device)
    run = load_run(out, device=device)
    errors = _measure(run, plan)
    if errors is not None:
        line = {"iteration": run.iterations, "seconds": round(run.train_seconds, 3), "split": "test"}
        folder.append_metrics(line | {"psnr_ldr": round(errors.psnr, 4), "gaussians": run.gaussian_count})
        figures = {"border": errors.border, "elsewhere": errors.elsewhere, "share": errors.share}
        rounded = {name: round(value, 4) if value == value else None for name, value in figures.items()}
        folder.write_summary(run.summary() | {"borders": rounded})
        if errors.share > 0:
            message = "held-out photos: %.2f dB near the borders of blocks (%.1f %% of the pixels), %.2f dB elsewhere"
            log.info(message, errors.border, 100 * errors.share, errors.elsewhere)
    return run


def _check(out: Path, *, resume: bool, overwrite: bool) -> bool:
    """Return whether the folder holds a training in blocks to continue; raise InputError if it cannot be used."""
    for name in (FOLDER, FILE):
        refuse_links(out / name, out)
    if is_in_blocks(out) and (resume or overwrite):
        return resume
    RunWriter(out).check_start(resume=False, overwrite=overwrite)
    return False


def _is_merged(out: Path, plan: BlockPlan, device: torch.device) -> bool:
    """Return whether all blocks are trained, and the merged run is newer and has refined borders if they can be."""
    folders = [folder_of(out, plan, index) for index in range(len(plan.blocks))]
    if not all(is_finished(folder) for folder in (out, *folders)):
        return False
    if device.type != "cpu" and not RunFolder(out).read_summary().get("borders_refined"):
        return False
    merged, *blocks = (RunFolder(folder).confidence.stat().st_mtime_ns for folder in (out, *folders))
    return merged > max(blocks)


def _continue(out: Path, data: LoadArguments, config: Config, count: int | None) -> BlockPlan:
    """Return the plan of a training in blocks to continue; raise InputError if the options differ."""
    plan = BlockPlan.read(out)
    for index in range(len(plan.blocks)):
        refuse_links(folder_of(out, plan, index), out)
    remedy = "continue with the same photos and options, or train anew with --overwrite"
    if data != plan.data:
        name = next(name for name in data | plan.data if data.get(name) != plan.data.get(name))
        problem = f"{name} = {plan.data.get(name)!r}, but {data.get(name)!r} was asked for"
        raise InputError(out / FILE, problem, remedy)
    if count is not None and count != len(plan.blocks):
        raise InputError(out / FILE, f"has {len(plan.blocks)} blocks, but {count} were asked for", remedy)
    require_same_config(config, plan.config, out / FILE, remedy)
    return plan


def _measure(run: Run, plan: BlockPlan) -> SeamErrors | None:
    """Return the errors of the merged run on held-out photos; None without any pixel of one."""
    names = [entry.name for entry in run.cameras if entry.split == "test" and entry.camera.is_pinhole]
    names = every_nth(names, MOST_VIEWS)
    if not names:
        return None
    scene = plan.load_scene(names)
    errors = measure_seams(run, run.normalize_photos(scene).views, plan.division)
    return None if math.isnan(errors.psnr) else errors  # Masks may exclude all pixels.
