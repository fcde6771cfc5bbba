"""What held-out photos say of a field while it trains."""

import torch

from ..evaluation.metrics import psnr
from ..evaluation.protocols import normalise, tone_map
from ..field.radiance_field import RadianceField
from ..scene import View

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
            images = normalise("gt-max", hdr, torch.tensor(view.hdr, device=device), mask)
            scores.setdefault("psnr_mu", []).append(min(psnr(*tone_map("gt-max", *images), mask), BEST))
    return {name: sum(values) / len(values) for name, values in scores.items()}
