"""Densification strategies: how the number of Gaussians changes during training.

"mcmc" is 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al., NeurIPS 2024), "adc" the adaptive
density control of 3D Gaussian Splatting (Kerbl et al. 2023, section 5.2, with the constants of its code).
"""

import math

from ...runs.config import Config
from .adc import AdcStrategy
from .base import SEED_STRIDE, MakeSeeds, Schedule, Seeds, Strategy
from .mcmc import DENSE, McmcStrategy, mcmc_cap

__all__ = [
    "SEED_STRIDE",
    "AdcStrategy",
    "MakeSeeds",
    "McmcStrategy",
    "Seeds",
    "Strategy",
    "make_strategy",
    "mcmc_cap",
]


def make_strategy(config: Config, pixels: int, *, large_scene: bool = False) -> AdcStrategy | McmcStrategy:
    """Create the strategy that config.densification.strategy names.

    The training photos have `pixels` in all. large_scene: as of scene_facts.is_large().
    """
    schedule, prune_opacity = Schedule.from_config(config), config.densification.prune_opacity
    if config.densification.strategy == "adc":
        cap, reset_every = config.densification.cap_max, config.scaled(config.adc.reset_every)
        return AdcStrategy(schedule, cap, prune_opacity, options=config.adc, reset_every=reset_every)
    cap = mcmc_cap(config, pixels)
    return McmcStrategy(
        schedule,
        cap,
        prune_opacity,
        options=config.mcmc,
        random_seed=config.seed,
        dense=large_scene and cap > DENSE * math.sqrt(pixels),
    )
