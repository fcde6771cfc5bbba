"""How a prediction and its truth are brought to one scale before the mu-law: three protocols, always named.

Figures of different protocols are not comparable: an error of scale of 1.1, 1.5, 2 or 4 costs down to 39.0, 26.5, 21.8
and 15.8 dB of mu-law PSNR.

gt-max    HDR-NeRF (eval_hdr.py): both are divided by the maximum of the view's truth and limited to [0, 1].
self-max  HDR-GS (train_synthetic.py, dataset_readers.py), Mono-HDR-GS: each image is divided by its own maximum; the
          tone-mapped truth is cut down to whole codes of 8 bits, the prediction is not; PSNR is the mean over channels.
aligned   ours: the prediction is first multiplied by one factor for the whole scene, fitted in log radiance on what the
          training photos do not show clipped; then as gt-max. It tells what is left beside the unknowable scale.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

from .metrics import maximum, mu_law, psnr, region_masks

PROTOCOLS = ("gt-max", "self-max", "aligned")
# Values below this fraction of a view's maximum do not vote on the scale: their logarithm is noise.
VOTING_FLOOR = 1e-4
# Votes taken from one view; evenly spaced pixels, so that large photos cost no memory.
VOTES_PER_VIEW = 65536
# Fewer than these, such as a few mixed pixels at the border of a white photo, decide nothing alone.
LEAST_VOTES = 100


def normalise(
    protocol: str, prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, scale: float | None = None
) -> tuple[Tensor, Tensor]:
    """Relative radiance of prediction and truth, [H, W, 3] float64 each, the truth's maximum at 1; not yet limited.

    mask: [H, W]; maxima are taken where it is above 0. scale: the factor of fit_scale, for `aligned` alone.
    """
    prediction, truth = prediction.double(), truth.double()
    unit = maximum(truth, mask)
    own = {"gt-max": unit, "self-max": maximum(prediction, mask), "aligned": unit / (scale or 1.0)}[protocol]
    return prediction / own, truth / unit


def tone_map(protocol: str, prediction: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """The mu-law images that the protocol compares, [H, W, 3] float64 in [0, 1], of what normalise() gave."""
    prediction, truth = mu_law(prediction), mu_law(truth)
    if protocol == "self-max":
        # A little more than exact, so that a whole code does not fall below itself by rounding.
        truth = torch.floor(truth * 255 + 1e-9) / 255
    return prediction, truth


def tone_mapped_psnr(protocol: str, prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """PSNR in dB of two images made by tone_map, averaged over channels as the protocol's own code does."""
    return psnr(prediction, truth, mask, channels_apart=protocol == "self-max")


def fit_scale(views: Iterable[tuple[Tensor, Tensor, Tensor | None, Tensor | None]]) -> float | None:
    """The factor that takes predictions to the truth: exp of the median of log(truth / prediction); None without votes.

    views: (prediction, truth, mask or None, photo or None) of the training views, [H, W, 3] each. A channel votes whose
    truth is above 1e-4 of the view's maximum and whose prediction is not black, where the photo does not clip: it does
    not tell such light. Clipped pixels vote where fewer than LEAST_VOTES others do.
    """
    votes, guesses = [], []
    for prediction, truth, mask, photo in views:
        prediction, truth = prediction.double(), truth.double()
        valid = truth > VOTING_FLOOR * maximum(truth, mask)
        # No floor for the prediction: its scale is what is sought, and one wild highlight would set its maximum.
        valid &= (prediction > 0) & prediction.isfinite()
        if mask is not None:
            valid &= (mask > 0.5)[..., None]
        clipped = torch.zeros_like(valid) if photo is None else region_masks(photo)["clipped"][..., None]
        votes.append(log_ratios(prediction, truth, valid & ~clipped))
        if sum(map(len, votes)) < LEAST_VOTES:
            guesses.append(log_ratios(prediction, truth, valid & clipped))
    if sum(map(len, votes)) < LEAST_VOTES:
        votes += guesses
    return median_factor(votes)


def log_ratios(prediction: Tensor, truth: Tensor, chosen: Tensor) -> Tensor:
    """[K] log(truth / prediction) of the chosen values, evenly spaced where they are too many."""
    ratios = (truth[chosen] / prediction[chosen]).log()
    return ratios[:: max(1, -(-len(ratios) // VOTES_PER_VIEW))].cpu()


def median_factor(votes: list[Tensor]) -> float | None:
    """exp of the median of what log_ratios gave for several views; None without votes."""
    joined = torch.cat(votes) if votes else torch.zeros(0)
    return float(joined.median().exp()) if len(joined) else None
