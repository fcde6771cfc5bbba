"""The cost of a planned training, whole and in blocks, for `train --plan-only`."""

import math
from dataclasses import replace

import torch

from ..parallel import thread_count
from ..runs.config import Config
from ..runs.config_files import override_config
from ..subsets import counted
from ..training.cost import Choice, Workload, choices, cpu_cost, recommend
from ..training.initialization import start_count
from ..training.plan import STEPS_PER_PHOTO, Plan
from ..training.scene_facts import SceneFacts
from ..training.strategies import mcmc_cap
from .block_plan import blocks_for


def estimate(plan: Plan, requested: Config, device: torch.device, gpus: int = 1) -> tuple[list[Choice], str]:
    """Return ways to train a set with their cost, and which of them is recommended.

    Blocks share the mcmc.cap_density of the `requested` config, 120 by default, and one training has that of its plan,
    more on a GPU with many photos: see BlockPlan.config_of(). On the CPU, figures of an H100 follow this machine's.
    """
    facts, config = plan.facts, plan.config
    pixels, steps = facts.pixels / facts.photos, config.schedule.iterations
    whole = Workload(facts.photos, pixels, _final_count(facts, config), steps, facts.pixel_bytes)
    divided_config = override_config(config, {"mcmc.cap_density": requested.mcmc.cap_density}, "plan")
    blocks = blocks_for(facts.photos, facts.pixels, divided_config)
    gaussians_needed = divided_config.mcmc.cap_density * math.sqrt(facts.pixels) if blocks > 1 else 0.0
    divided = replace(
        whole,
        gaussians=max(_final_count(facts, divided_config), gaussians_needed),
        iterations=max(whole.iterations, STEPS_PER_PHOTO * facts.photos),
    )
    if device.type == "cuda":
        memory = float(torch.cuda.get_device_properties(device).total_memory)
        return choices(whole, divided, blocks, memory, gpus), recommend(whole, divided, blocks, memory, gpus)
    threads = thread_count()
    here = Choice(f"CPU, {counted(threads, 'thread', 'threads')}", cpu_cost(whole, threads))
    others = [replace(each, name=f"{each.name} (H100)") for each in choices(whole, divided, blocks, None, gpus)]
    recommended = (
        recommend(whole, divided, blocks, None) if blocks > 1 else "this machine, or one GPU if that takes too long"
    )
    return [here, *others], recommended


def _final_count(facts: SceneFacts, config: Config) -> float:
    """Return the number of Gaussians at the end of one training."""
    cap = mcmc_cap(config, facts.pixels) if config.densification.strategy == "mcmc" else config.densification.cap_max
    return max(min(facts.points, config.densification.cap_max), start_count(config, facts.pixels), cap)
