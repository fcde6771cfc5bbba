"""The model of cost, against measurements in docs/reports that it was fitted to and others."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sehdr_warp.blocks.estimate import estimate
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.cost import (
    FIXED_BYTES,
    GAUSSIAN_BYTES,
    PIXEL_BYTES,
    Workload,
    block_cost,
    choices,
    exchange_seconds,
    gain_of_ranks,
    recommend,
    step_seconds,
    training_cost,
)
from sehdr_warp.training.plan import make_plan
from sehdr_warp.training.training_views import ViewDataset

from .toy import toy_scene

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "reports" / "results"
SURVEY = Workload(20_000, 20e6, 76e6, 1_500_000)


def rows(name, **fields):
    result = json.loads((RESULTS / f"{name}.json").read_text())
    for part in result if isinstance(result, list) else [result]:
        yield from (row for row in part["rows"] if all(row.get(key) == value for key, value in fields.items()))


def error(estimate, measured):
    return abs(estimate / measured - 1)


def test_steps_take_as_long_as_measured():
    for row in rows("large", method="sehdr-warp"):
        estimate = step_seconds(row["width"] * row["height"], row["gaussians"])
        assert error(1e3 * estimate, row["step_ms"]) < 0.1
    for row in rows("gpus", workers=1):
        assert error(1e3 * step_seconds(row["width"] * row["height"], row["gaussians"]), row["amortized_ms"]) < 0.1
    for row in rows("step", preset="default", implementation="sehdr-warp"):
        assert error(1e3 * step_seconds(row["width"] * row["height"], row["gaussians"]), row["amortized_ms"]) < 0.1


def test_two_gpus_take_as_long_as_measured():
    """The times are of H100; the exchange was fitted to H200."""
    for row in rows("gpus", workers=2):
        step = step_seconds(row["width"] * row["height"], row["gaussians"]) + exchange_seconds(row["gaussians"], 2)
        assert error(1e3 * step / 2, row["amortized_ms"]) < 0.1


def test_memory_is_as_measured():
    """The estimate was fitted to most of these captures; synthetic scenes, with smaller Gaussians, need less.

    Masks take four bytes a pixel beside the three of a photo.
    """
    for row in rows("captures", method="sehdr-warp"):
        if row.get("memory"):
            photos, pixels = int(row["photos"].split()[0]), 0.75 * row["size"] ** 2
            photo_bytes = (7 if "masked" in row["capture"] else 3) * photos * pixels
            estimate = FIXED_BYTES + GAUSSIAN_BYTES * row["gaussians"] + PIXEL_BYTES * pixels + photo_bytes
            assert error(estimate, row["memory"]) < 0.25
    for row in rows("large", method="sehdr-warp"):
        pixels = row["width"] * row["height"]
        estimate = FIXED_BYTES + GAUSSIAN_BYTES * row["gaussians"] + PIXEL_BYTES * pixels + 3 * 24 * pixels
        assert 1 < estimate / row["memory"] < 1.7


def test_blocks_take_as_long_and_as_much_memory_as_measured():
    """Predict a block of a town of 400 photos of 560 x 420 pixels; its memory was not used for the fit."""
    for row in rows("blocks"):
        if row["what"].startswith("block_") and row.get("steps"):
            cost = training_cost(Workload(row["photos"], 560 * 420, row["gaussians"], row["steps"]))
            assert error(cost.seconds, row["seconds"]) < 0.25
            assert error(cost.gpu_bytes + cost.photo_bytes, row["peak_memory_bytes"]) < 0.3


def test_more_gpus_and_blocks_cost_what_they_must():
    small = Workload(200, 2e6, 1e6, 15_000)
    times = [training_cost(small, gpus).seconds for gpus in (1, 2, 4)]
    assert times == sorted(times, reverse=True)
    assert training_cost(small, 4, 4).seconds > training_cost(small, 4).seconds, "networks are slower than NVLink"
    assert training_cost(small, 4, 4).network_bytes > 0 == training_cost(small, 4).network_bytes
    one, two = block_cost(SURVEY, 64), block_cost(SURVEY, 64, 2)
    assert two.seconds == pytest.approx(one.seconds / 2) and one.gpu_bytes < 0.07 * training_cost(SURVEY).gpu_bytes


def test_recommendations():
    small = Workload(400, 4e6, 3e6, 30_000)
    assert recommend(small, small, 1, 80e9) == "one GPU: the set is one training"
    assert recommend(small, small, 1, 80e9, 2).startswith("--gpus 2: 1.")
    assert recommend(SURVEY, SURVEY, 65, 80e9, 2).startswith("--blocks 65: the set fills 65 trainings")
    large, fewer = (replace(small, gaussians=count) for count in (2e8, 1e8))  # Blocks share fewer on a GPU.
    assert recommend(large, large, 1, 80e9).startswith("--blocks 4: 225 GB are more than the 80 GB")
    assert recommend(large, fewer, 1, 80e9).startswith("--blocks 2: 225 GB")
    fits = {choice.name: choice.fits for choice in choices(large, SURVEY, 65, 80e9)}
    assert not fits["1 GPU"] and fits["65 blocks on 1 GPU"]


def test_masks_and_wide_codes_count_as_photos():
    """Photos on the device have codes of one type, and a mask for each photo if one has a mask."""
    views = list(toy_scene().views)
    pixels = sum(view.codes.shape[0] * view.codes.shape[1] for view in views if view.split == "train")

    def estimated(*views):
        scene = replace(toy_scene(), views=views)
        device = torch.device("cpu")
        plan = make_plan(scene, load_config("fast", {"response.name": "srgb"}), device)
        source = ViewDataset(scene.train_views, 1.0, "cpu", truth=False)
        assert all(choice.cost.photo_bytes == source.bytes for choice in estimate(plan, plan.config, device)[0])
        return source.bytes / pixels

    masked = replace(views[0], mask=np.ones(views[0].codes.shape[:2], np.float32))
    wide = replace(views[1], codes=views[1].codes.astype(np.uint16) * 257)
    assert [estimated(*views), estimated(masked, *views[1:])] == [3, 7]
    assert [estimated(views[0], wide, *views[2:]), estimated(masked, wide, *views[2:])] == [6, 10]


def test_gpus_that_gain_nothing_are_not_listed_unless_they_are_named():
    quick = Workload(20, 1e4, 3e4, 2000)
    assert [choice.name for choice in choices(quick, quick, 1, None)] == ["1 GPU"]
    assert [choice.name for choice in choices(quick, quick, 1, None, 4)] == ["1 GPU", "4 GPUs"]
    long = replace(quick, pixels=2e6, gaussians=1e6, iterations=30_000)
    assert len(choices(long, long, 1, None)) == 5


def test_small_scenes_get_a_line_that_more_gpus_gain_nothing():
    gpu = torch.device("cuda", 0)
    assert "too few to gain" in gain_of_ranks(2, 2_000, 10_000, 4000, gpu)
    large = gain_of_ranks(2, 1_000_000, 2_000_000, 30_000, gpu)
    assert "estimated 1." in large and "too few" not in large
    assert "no faster than one" in gain_of_ranks(2, 1_000_000, 2_000_000, 30_000, torch.device("cpu"))
    assert math.isfinite(float(gain_of_ranks(8, 10**6, 10**6, 10**4, gpu).split("estimated ")[1].split()[0]))
