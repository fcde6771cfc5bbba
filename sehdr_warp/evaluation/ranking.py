"""Measure whether confidence ranks errors: Spearman's correlation between 1 - confidence and the error of pixels."""

from typing import NamedTuple

import torch
from torch import Tensor

from ..subsets import every_nth
from .metrics import mu_law
from .protocols import log_ratios, median_factor

MAX_PIXELS = 16384  # Evenly spaced pixels that are ranked of one view
DARKEST_CODE = 0.5 / 255
"""The value of a photo that is stored as black. Darker light counts as this, before logarithms."""


class ViewPixels(NamedTuple):
    """Pixels of one view, [K] or [K, 3] float64 each."""

    confidence: Tensor
    prediction: Tensor
    truth: Tensor
    well_exposed: Tensor
    black: float  # Radiance that the photo shows as black, in the unit of the prediction
    max_truth: float  # Largest radiance of the truth; 1 if there is no light


class ErrorRanking:
    """Gathers confidence, prediction and truth of held-out views; all views of a scene are ranked together."""

    def __init__(self):
        """Start without views."""
        self._views: list[ViewPixels] = []

    def add(
        self,
        confidence: Tensor,
        prediction: Tensor,
        truth: Tensor,
        well_exposed: Tensor,
        black: float,
        mask: Tensor | None = None,
    ) -> None:
        """Add a view.

        Args:
            confidence: [H, W] in [0, 1].
            prediction: radiance, [H, W, 3].
            truth: radiance, [H, W, 3].
            well_exposed: pixels that the photo neither clips nor shows as dark, [H, W] bool.
            black: radiance that the photo shows as black, in the unit of the prediction.
            mask: [H, W]; pixels above 0.5 count.
        """
        inside = torch.ones_like(well_exposed) if mask is None else mask > 0.5
        max_truth = float(truth[inside].max()) if bool(inside.any()) else 0.0
        images = (confidence.double(), prediction.double().clamp_min(0), truth.double(), well_exposed)
        pixels = (every_nth(image[inside], MAX_PIXELS).cpu() for image in images)
        self._views.append(ViewPixels(*pixels, black=black, max_truth=max_truth or 1.0))

    def result(self) -> dict:
        """Rank the pixels of all views by confidence and by error.

        The error of a pixel is the mean over channels of

        log2    |log2((scale prediction + black) / (truth + black))|, black in the truth's unit, stops
        mu      |mu-law(scale prediction) - mu-law(truth)|, both over the largest truth of the view

        scale brings predictions to the truth by the median over the well-exposed pixels that are ranked; it is 1 if
        there are none.

        Returns:
            "spearman_log2" and "spearman_mu" in [-1, 1], "mean" of the confidence, "pixels" and "scale"; None with a
            "reason" if nothing can be ranked.
        """
        figures = dict.fromkeys(("spearman_log2", "spearman_mu", "mean", "scale")) | {"pixels": 0}
        confidence = torch.cat([view.confidence for view in self._views]) if self._views else torch.zeros(0)
        if not len(confidence):
            return figures | {"reason": "the run's confidence was not measured"}
        votes = []
        for view in self._views:
            voting = (view.prediction > 0) & (view.truth > 0) & view.well_exposed[:, None]
            votes.append(log_ratios(view.prediction, view.truth, voting))
        scale = median_factor(votes) or 1.0
        errors_log2, errors_mu = [], []
        for view in self._views:
            prediction, black = scale * view.prediction, scale * view.black
            errors_log2.append(((prediction + black) / (view.truth + black)).log2().abs().mean(1))
            pair = mu_law(prediction / view.max_truth), mu_law(view.truth / view.max_truth)
            errors_mu.append((pair[0] - pair[1]).abs().mean(1))
        figures |= {"mean": float(confidence.mean()), "pixels": len(confidence), "scale": scale}
        figures["spearman_log2"] = spearman(1 - confidence, torch.cat(errors_log2))
        figures["spearman_mu"] = spearman(1 - confidence, torch.cat(errors_mu))
        constant = {"reason": "all pixels have one confidence or one error"}
        return figures | (constant if figures["spearman_log2"] is None else {})


def spearman(first: Tensor, second: Tensor) -> float | None:
    """Return Spearman's rank correlation of two [K] tensors, ties at their mean rank; None if one is constant."""
    from scipy.stats import rankdata

    ranks = torch.stack([torch.from_numpy(rankdata(values.numpy())) for values in (first, second)])
    return float(torch.corrcoef(ranks)[0, 1]) if bool((ranks.std(1) > 0).all()) else None
