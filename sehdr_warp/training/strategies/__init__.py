"""Densification strategies: how the number of Gaussians changes during training.

"mcmc" is 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al., NeurIPS 2024), "adc" the adaptive
density control of 3D Gaussian Splatting (Kerbl et al. 2023, section 5.2, with the constants of its code).
"""

from torch import Tensor

from ...runs.config import Config
from .adc import AdcStrategy
from .base import SEED_STRIDE, Proposals, Propose, Strategy
from .mcmc import McmcStrategy, mcmc_cap

__all__ = [
    "SEED_STRIDE",
    "AdcStrategy",
    "McmcStrategy",
    "Proposals",
    "Propose",
    "Strategy",
    "make_strategy",
    "mcmc_cap",
]


def make_strategy(
    config: Config, pixels: int, camera_positions: Tensor | None = None, *, large_scene: bool = False
) -> AdcStrategy | McmcStrategy:
    """Create the strategy that config.densification.strategy names.

    The training photos have `pixels` in all and camera_positions [V, 3], in the Gaussians' coordinates. large_scene: as
    of scene_facts.is_large().
    """
    if config.densification.strategy == "adc":
        return AdcStrategy.from_config(config)
    return McmcStrategy.from_config(config, pixels, camera_positions, large_scene=large_scene)
