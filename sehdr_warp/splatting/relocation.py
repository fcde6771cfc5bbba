"""Gaussians that move to where others are, on either device without waiting for it (kernels/relocation.py)."""

import math
from functools import cache

import torch
from torch import Tensor

from ..kernels import relocation as kernels
from .launching import launch

MOST_COPIES = 51
"""A Gaussian is shared by at most this many at once, as in the authors' code: the binomial sums stay exact."""


@torch.no_grad()
def share_opacities(logits: Tensor, log_scales: Tensor, copies: Tensor, *, least: float) -> None:
    """Makes each of the Gaussians with copies, in place, the n-th part of itself, n = 1 + its copies, up to MOST_COPIES
    (3DGS-MCMC, equation 9): these together look as it did.

    logits: [N] of opacities; log_scales: [N, 3]; float32. copies: [N] int64. least: opacity that remains, in (0, 1).
    """
    given = copies, relocation_sums(logits.device), least
    launch(kernels.share_opacities, len(logits), *given, logits, log_scales)


@torch.no_grad()
def copy_rows(values: Tensor, sources: Tensor, given: Tensor) -> None:
    """values[i] = given[sources[i]], in place, where sources [N] int64 is not negative. values: [N, ...], given: [M,
    ...], both contiguous float32; given may be values, where no row is both read and written."""
    if values.numel() and given.numel():
        rows = (tensor.view(len(tensor), -1) for tensor in (given, values))
        launch(kernels.copy_rows, values.numel(), sources, *rows)


@cache
def relocation_sums(device: torch.device) -> Tensor:
    """[MOST_COPIES, MOST_COPIES] float64; row n - 1 dotted with (o, o^2, ...) is the denominator of equation 9 for n:
    sum over i <= n and k < i of binomial(i - 1, k) (-1)^k o^(k + 1) / sqrt(k + 1)."""
    # The binomials of a column sum to one binomial (hockey stick).
    rows = [
        [math.comb(n, k + 1) * (-1) ** k / math.sqrt(k + 1) if k < n else 0.0 for k in range(MOST_COPIES)]
        for n in range(1, MOST_COPIES + 1)
    ]
    return torch.tensor(rows, dtype=torch.float64, device=device)
