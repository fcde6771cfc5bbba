"""How good a trained run is: metrics, the protocols that bring two scales together, and held-out evaluation."""

from .evaluate import evaluate
from .lpips import Lpips, load_lpips
from .metrics import mu_law, psnr, pu21_encode, pu21_metrics, region_masks, ssim
from .protocols import PROTOCOLS, fit_scale, normalise, tone_map
from .table import format_table

__all__ = [
    "PROTOCOLS",
    "Lpips",
    "evaluate",
    "fit_scale",
    "format_table",
    "load_lpips",
    "mu_law",
    "normalise",
    "psnr",
    "pu21_encode",
    "pu21_metrics",
    "region_masks",
    "ssim",
    "tone_map",
]
