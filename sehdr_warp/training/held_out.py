"""Evaluation of a field on held-out photos during a training."""

import logging
from collections.abc import Mapping, Sequence

import torch

from ..evaluation.metrics import psnr
from ..evaluation.protocols import normalize, tone_map
from ..model.radiance_field import RadianceField
from ..scene import View

log = logging.getLogger(__name__)

OVERFITTING_DB = 0.2  # Decibels by which the last score may be below the best one without a warning
MAX_DB = 100.0  # Score of identical images, so that a mean over views is finite


@torch.no_grad()
def evaluate_views(field: RadianceField, views: tuple[View, ...], degree: int) -> dict[str, float]:
    """Return mean scores over views, in dB; empty without views.

    Returns:
        "psnr_ldr": Simulated photo against photo, inside the masks. "psnr_mu": HDR against truth in the mu-law,
        protocol "gt-max", over the views with HDR truth.
    """
    device = field.gaussians.means.device
    scores: dict[str, list[float]] = {}
    for view in views:
        mask = None if view.mask is None else torch.tensor(view.mask, device=device)
        photo = torch.tensor(view.image, device=device)
        predicted = field.render_ldr(view.camera, view.exposure_time, degree=degree)
        scores.setdefault("psnr_ldr", []).append(min(psnr(predicted, photo, mask), MAX_DB))
        if view.hdr is not None:
            hdr = field.render(view.camera, degree=degree).hdr
            images = normalize("gt-max", hdr, torch.tensor(view.hdr, device=device), mask)
            scores.setdefault("psnr_mu", []).append(min(psnr(*tone_map("gt-max", *images), mask), MAX_DB))
    return {name: sum(values) / len(values) for name, values in scores.items()}


def format_scores(scores: Mapping[str, float]) -> str:
    """Format the scores of evaluate_views() for a log line."""
    formats = {"psnr_ldr": "held-out photos {:.1f} dB", "psnr_mu": "HDR {:.1f} dB (mu-law)"}
    return ", ".join(text.format(scores[name]) for name, text in formats.items() if name in scores)


def warn_of_overfitting(metrics: Sequence[dict]) -> None:
    """Warn if held-out photos scored better earlier in the training.

    Args:
        metrics: The lines of metrics.jsonl.
    """
    scores = [(line["psnr_ldr"], line["iteration"]) for line in metrics if "psnr_ldr" in line]
    if scores and (best := max(scores))[0] > scores[-1][0] + OVERFITTING_DB:
        log.warning(
            "held-out photos scored best at iteration %d (%.2f dB), now %.2f dB: train fewer iterations",
            *(best[1], best[0], scores[-1][0]),
        )
