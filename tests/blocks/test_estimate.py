"""Cost of blocks: time and memory as a plan states them."""

from dataclasses import replace

import pytest
import torch

from sehdr_warp.blocks.estimate import estimate
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import override_config
from sehdr_warp.scene import load_scene
from sehdr_warp.training.plan import make_plan


def test_the_estimate_has_the_blocks_of_auto_and_their_gaussians(survey):
    """A plan may give a single training more Gaussians, which blocks do not get."""
    plan = make_plan(load_scene(survey), override_config(Config(), {"response.name": "srgb"}), "cpu")
    dense = override_config(plan.config, {"mcmc.cap_density": 240.0})
    for photos, blocks in ((400, 1), (1200, 4)):
        many = replace(plan, config=dense, facts=replace(plan.facts, photos=photos, pixels=photos * 10**6))
        choices, recommended = estimate(many, Config(), torch.device("cpu"))
        assert (f"--blocks {blocks}:" in recommended) == (blocks > 1)
        assert {choice.name.startswith(f"{blocks} blocks") for choice in choices if "block" in choice.name} <= {True}
    cost = next(choice.cost for choice in choices if choice.name.startswith("4 blocks"))
    assert cost.disk_bytes == pytest.approx((4 * 1.3 / 4 + 1 / 4) * 940 * 120 * (1200e6) ** 0.5)
