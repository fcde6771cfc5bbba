"""Whether confidence ranks errors: Spearman's correlation between doubt (1 - confidence) and pixels' true error."""

import torch
from torch import Tensor

from .metrics import mu_law
from .protocols import log_ratios, median_factor

MOST_PIXELS = 16384
"""Taken from one view, evenly spaced."""
DARKEST_CODE = 0.5 / 255
"""An exposure that is stored as black: light below it counts as it, in truth and render, before logarithms."""


class ErrorRanking:
    """Gathers confidence, render and truth of held-out views' pixels; all views of a scene are ranked together."""

    def __init__(self):
        self._views: list[tuple[Tensor, Tensor, Tensor, Tensor, float, float]] = []

    def add(self, confidence, prediction, truth, well_exposed, darkest: float, mask: Tensor | None = None) -> None:
        """confidence, mask (pixels above 0.5 count): [H, W] in [0, 1]. prediction, truth: [H, W, 3] radiance.
        well_exposed: [H, W] bool, of the photo. darkest: radiance that the photo shows as black, in the render's unit.
        """
        counted = torch.ones_like(well_exposed) if mask is None else mask > 0.5
        unit = float(truth[counted].max()) if bool(counted.any()) else 0.0
        step = max(1, -(-int(counted.sum()) // MOST_PIXELS))
        images = (confidence.double(), prediction.double().clamp_min(0), truth.double(), well_exposed)
        self._views.append((*(image[counted][::step].cpu() for image in images), darkest, unit or 1.0))

    def result(self) -> dict:
        """{"spearman_log2", "spearman_mu": in [-1, 1], "mean": of the confidence, "pixels", "scale"}; null with
        "reason" where nothing can be ranked. The error of a pixel is the mean over channels of

        log2    |log2((scale prediction + black) / (truth + black))|, black = scale darkest, stops
        mu      |mu-law(scale prediction) - mu-law(truth)|, both over the largest truth of the view

        scale takes the renders to the truth by the median over the well-exposed pixels that are ranked; else it is 1.
        """
        figures = dict.fromkeys(("spearman_log2", "spearman_mu", "mean", "scale")) | {"pixels": 0}
        confidence = torch.cat([view[0] for view in self._views]) if self._views else torch.zeros(0)
        if not len(confidence):
            return figures | {"reason": "the run's confidence was not measured"}
        votes = [log_ratios(a, b, (a > 0) & (b > 0) & voting[:, None]) for _, a, b, voting, *_ in self._views]
        scale = median_factor(votes) or 1.0
        stops, steps = [], []
        for _, prediction, truth, _, darkest, unit in self._views:
            ratio = (scale * prediction + scale * darkest) / (truth + scale * darkest)
            stops.append(ratio.log2().abs().mean(1))
            steps.append((mu_law(scale * prediction / unit) - mu_law(truth / unit)).abs().mean(1))
        figures |= {"mean": float(confidence.mean()), "pixels": len(confidence), "scale": scale}
        for name, errors in (("log2", stops), ("mu", steps)):
            figures[f"spearman_{name}"] = spearman(1 - confidence, torch.cat(errors))
        constant = {"reason": "all pixels have one confidence or one error"}
        return figures | (constant if figures["spearman_log2"] is None else {})


def spearman(first: Tensor, second: Tensor) -> float | None:
    """Spearman's rank correlation of two [K] tensors, ties at their mean rank; None where one of them is constant."""
    from scipy.stats import rankdata

    ranks = torch.stack([torch.from_numpy(rankdata(values.numpy())) for values in (first, second)])
    return float(torch.corrcoef(ranks)[0, 1]) if bool((ranks.std(1) > 0).all()) else None
