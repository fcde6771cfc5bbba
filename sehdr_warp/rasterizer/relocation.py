"""Gaussians that move to where others are, on either device without waiting for it (kernels/relocation.py)."""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import relocation as kernels
from .warp_launch.launching import launch
from .warp_launch.threads import single_range

MOST_COPIES = 51
"""A Gaussian is shared by at most this many at once, as in the authors' code: the binomial sums stay exact."""


@torch.no_grad()
def share_opacities(logits: Tensor, log_scales: Tensor, copies: Tensor, *, least: float) -> None:
    """Makes each of the Gaussians with copies, in place, the n-th part of itself, n = 1 + its copies, up to MOST_COPIES
    (3DGS-MCMC, equation 9): these together look as it did.

    logits: [N] of opacities; log_scales: [N, 3]; float32. copies: [N] int32. least: opacity that remains, in (0, 1).
    """
    given = copies, relocation_sums(logits.device), least
    launch(kernels.share_opacities, len(logits), *given, logits, log_scales)


@torch.no_grad()
def number_places(dead: Tensor, added: int) -> tuple[Tensor, Tensor]:
    """The places to be filled, numbered from 0 on: [N + added] int32, of the dead ones of N rows and then of as many
    rows behind them, -1 for the living; and how many the dead are, int64 scalar. dead: [N] bool, N >= 1."""
    numbers = dead.cumsum(0)
    places = torch.empty(len(dead) + added, dtype=torch.int32, device=dead.device)
    launch(kernels.number_places, len(places), dead, numbers, places)
    return places, numbers[-1]


@torch.no_grad()
def count_copies(drawn: "Drawn", begin: Tensor, end: Tensor, changed: Tensor) -> Tensor:
    """[N] int32: for how many of the places from begin to end, int64 scalars, each of N rows is drawn; those that are
    at all are marked in changed [N] bool."""
    copies = torch.zeros(len(changed), dtype=torch.int32, device=changed.device)
    count = len(drawn.rows)
    launch(kernels.count_copies, count, *drawn, begin, end, copies, changed, ranges=single_range(count))
    return copies


@torch.no_grad()
def copy_rows(
    values: Sequence[Tensor],
    given: Sequence[Tensor],
    places: Tensor,
    begin: Tensor,
    end: Tensor,
    *,
    drawn: "Drawn | None" = None,
    changed: Tensor | None = None,
) -> None:
    """Fills the rows whose place is begin + k, below end, with row k of what is given, or the k-th drawn, in place.

    values: [N, ...] each, given: [M, ...] each, contiguous float32; given may be values, where no row is both read and
    written. places: [N] int32, negative for rows that stay; begin, end: int64 scalars. changed: [N] bool, is told.
    """
    none = Drawn(places.new_empty(0, dtype=torch.int64), places.new_empty(0, dtype=torch.float64))
    told = places, begin, end, *(none if drawn is None else drawn)
    marked = torch.empty(0, dtype=torch.bool, device=places.device) if changed is None else changed
    for start in range(0, len(values), kernels.AT_ONCE):
        rows = (_rows(tensors[start : start + kernels.AT_ONCE]) for tensors in (given, values))
        launch(kernels.copy_rows, len(places), *told, *(row for each in rows for row in each), marked)


@torch.no_grad()
def clear_rows(values: Sequence[Tensor], which: Tensor) -> None:
    """Zeroes, in place, the rows of values, [N, ...] contiguous float32 each, that which [N] bool marks."""
    for start in range(0, len(values), kernels.AT_ONCE):
        launch(kernels.clear_rows, len(which), which, *_rows(values[start : start + kernels.AT_ONCE]))


class Drawn(NamedTuple):
    """rows: [K] int64, drawn by weights. total: float64 scalar, of the weights: where it is 0, nothing is drawn."""

    rows: Tensor
    total: Tensor


def _rows(tensors: Sequence[Tensor]) -> list[Tensor]:
    """The tensors as rows, and ones without columns for what is missing to AT_ONCE."""
    none = [tensors[0].new_empty(0, 0)] * (kernels.AT_ONCE - len(tensors))
    return [t.view(len(t), -1) if t.numel() else t.new_empty(0, 0) for t in tensors] + none


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
