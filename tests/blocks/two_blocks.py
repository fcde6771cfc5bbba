"""A town in two trained blocks, which the tests of merging and refining share."""

from pathlib import Path

import torch

from benchmarks.survey import write_survey
from sehdr_warp.blocks.block_plan import BlockPlan, make_block_plan
from sehdr_warp.blocks.job import train_block
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import override_config
from sehdr_warp.runs.values import LoadArguments
from sehdr_warp.training.launch import installed_versions

LITTLE = {"model.initial_density": 0.0, "mcmc.seed_fraction": 0.0, "loss.light_prior": False}


def train_two_blocks(folder: Path, iterations: int) -> BlockPlan:
    """Train two blocks of a town of 32 photos in FOLDER/run and return their plan."""
    write_survey(folder / "town", views=32, size=48, gaussians=6000)
    data: LoadArguments = {"path": str(folder / "town"), "exposure_index": None, "max_size": None, "holdout": None}
    fields = {"response.name": "srgb", "schedule.iterations": iterations}
    plan = make_block_plan(data, override_config(Config(), fields | LITTLE), torch.device("cpu"), 2)
    assert plan is not None
    (folder / "run").mkdir()
    plan.write(folder / "run")
    for index in (0, 1):
        assert train_block(folder / "run", index, "cpu", "auto", installed_versions()).error is None
    return plan
