"""What held-out photos say of a field while it trains."""

import logging
from collections.abc import Mapping, Sequence

import torch

from ..evaluation.metrics import psnr
from ..evaluation.protocols import normalize, tone_map
from ..model.radiance_field import RadianceField
from ..scene import View

log = logging.getLogger(__name__)

FALL = 0.2  # Decibels by which the last figure may be below the best before it is told
BEST = 100.0  # Identical images count this many dB, so that a mean over views stays a number


@torch.no_grad()
def evaluate_views(field: RadianceField, views: tuple[View, ...], degree: int) -> dict[str, float]:
    """Means over views, in dB, of psnr_ldr (simulated photo against photo, where the mask counts) and, over the views
    with HDR truth, of psnr_mu (mu-law, protocol "gt-max"). Empty without views."""
    device = field.gaussians.means.device
    scores: dict[str, list[float]] = {}
    for view in views:
        mask = None if view.mask is None else torch.tensor(view.mask, device=device)
        photo = torch.tensor(view.image, device=device)
        predicted = field.render_ldr(view.camera, view.exposure_time, degree=degree)
        scores.setdefault("psnr_ldr", []).append(min(psnr(predicted, photo, mask), BEST))
        if view.hdr is not None:
            hdr = field.render(view.camera, degree=degree).hdr
            images = normalize("gt-max", hdr, torch.tensor(view.hdr, device=device), mask)
            scores.setdefault("psnr_mu", []).append(min(psnr(*tone_map("gt-max", *images), mask), BEST))
    return {name: sum(values) / len(values) for name, values in scores.items()}


def figures_told(scores: Mapping[str, float]) -> str:
    """What evaluate_views() found, in words; empty without its figures."""
    told = {"psnr_ldr": "held-out photos {:.1f} dB", "psnr_mu": "HDR {:.1f} dB (mu-law)"}
    return ", ".join(text.format(scores[name]) for name, text in told.items() if name in scores)


def warn_of_fall(metrics: Sequence[dict]) -> None:
    """Tells where held-out photos were better some time ago. metrics: the lines of metrics.jsonl."""
    scores = [(line["psnr_ldr"], line["iteration"]) for line in metrics if "psnr_ldr" in line]
    if scores and (best := max(scores))[0] > scores[-1][0] + FALL:
        told = "held-out photos were best at iteration %d (%.2f dB), now %.2f dB: fewer iterations would do"
        log.warning(told, best[1], best[0], scores[-1][0])
