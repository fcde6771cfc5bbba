"""Three protocols that bring a prediction and its truth to one scale before the mu-law.

Figures of different protocols are not comparable: an error of scale of 1.1, 1.5, 2 or 4 costs down to 39.0, 26.5, 21.8
and 15.8 dB of mu-law PSNR.

gt-max    HDR-NeRF (eval_hdr.py): both are divided by the maximum of the view's truth and limited to [0, 1].
self-max  HDR-GS (train_synthetic.py, dataset_readers.py), Mono-HDR-GS: each image is divided by its own maximum; the
          tone-mapped truth is cut down to whole codes of 8 bits, the prediction is not; PSNR is the mean over channels.
aligned   ours: the prediction is first multiplied by one factor for the whole scene, fitted in log radiance on what the
          training photos do not show clipped; then as gt-max. It shows the error apart from the unknown scale.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

from ..subsets import every_nth
from .metrics import maximum, mu_law, psnr, region_masks

PROTOCOLS = ("gt-max", "self-max", "aligned")
VOTING_FLOOR = 1e-4
"""Values below this fraction of a view's maximum do not vote on the scale, because their logarithm is noise."""
VOTES_PER_VIEW = 65536  # Evenly spaced pixels of a view that vote, so that large photos need little memory
MIN_VOTES = 100
"""Fewer votes, such as those of mixed pixels at the border of a white photo, are joined by clipped pixels."""


def normalize(
    protocol: str, prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, scale: float | None = None
) -> tuple[Tensor, Tensor]:
    """Return relative radiance of prediction and truth with the truth's maximum at 1, not limited to [0, 1].

    Args:
        protocol: one of PROTOCOLS.
        prediction: radiance, [H, W, 3].
        truth: radiance, [H, W, 3].
        mask: [H, W]; maxima are taken where it is above 0.
        scale: the factor of fit_scale(), for "aligned" alone.

    Returns:
        [H, W, 3] float64 each.
    """
    prediction, truth = prediction.double(), truth.double()
    unit = maximum(truth, mask)
    own = {"gt-max": unit, "self-max": maximum(prediction, mask), "aligned": unit / (scale or 1.0)}[protocol]
    return prediction / own, truth / unit


def tone_map(protocol: str, prediction: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mu-law images that the protocol compares, [H, W, 3] float64 in [0, 1], from normalize()'s results."""
    prediction, truth = mu_law(prediction), mu_law(truth)
    if protocol == "self-max":
        # The offset keeps rounding from taking a whole code to the one below.
        truth = torch.floor(truth * 255 + 1e-9) / 255
    return prediction, truth


def tone_mapped_psnr(protocol: str, prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Return the PSNR of two images of tone_map(), dB, averaged over channels as the protocol's own code does."""
    return psnr(prediction, truth, mask, channels_apart=protocol == "self-max")


def fit_scale(views: Iterable[tuple[Tensor, Tensor, Tensor | None, Tensor | None]]) -> float | None:
    """Fit the factor that brings predictions to the truth: exp of the median of log(truth / prediction).

    A channel votes if its truth is above VOTING_FLOOR of the view's maximum, its prediction is not black, and the photo
    does not clip there, because a clipped photo does not determine the light. Clipped pixels vote if there are fewer
    than MIN_VOTES others.

    Args:
        views: prediction, truth, mask or None, and photo or None of the training views, [H, W, 3] each.

    Returns:
        The factor; None without votes.
    """
    votes, guesses = [], []
    for prediction, truth, mask, photo in views:
        prediction, truth = prediction.double(), truth.double()
        valid = truth > VOTING_FLOOR * maximum(truth, mask)
        # The prediction has no floor, because one wild highlight would set its maximum.
        valid &= (prediction > 0) & prediction.isfinite()
        if mask is not None:
            valid &= (mask > 0.5)[..., None]
        clipped = torch.zeros_like(valid) if photo is None else region_masks(photo)["clipped"][..., None]
        votes.append(log_ratios(prediction, truth, valid & ~clipped))
        if sum(map(len, votes)) < MIN_VOTES:
            guesses.append(log_ratios(prediction, truth, valid & clipped))
    if sum(map(len, votes)) < MIN_VOTES:
        votes += guesses
    return median_factor(votes)


def log_ratios(prediction: Tensor, truth: Tensor, pixels: Tensor) -> Tensor:
    """Return log(truth / prediction), [K], of at most VOTES_PER_VIEW evenly spaced values."""
    ratios = (truth[pixels] / prediction[pixels]).log()
    return every_nth(ratios, VOTES_PER_VIEW).cpu()


def median_factor(votes: list[Tensor]) -> float | None:
    """Return exp of the median of the results of log_ratios() for several views; None without votes."""
    joined = torch.cat(votes) if votes else torch.zeros(0)
    return float(joined.median().exp()) if len(joined) else None
