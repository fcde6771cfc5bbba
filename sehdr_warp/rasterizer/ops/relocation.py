"""Gaussians that move to where others are, on either device without waiting for it (kernels/relocation.py)."""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from ...kernels import relocation as kernels
from ..warp_launch.launching import launch
from ..warp_launch.threads import single_range

MOST_COPIES = 51
"""A Gaussian is shared by at most this many at once, as in the authors' code: the binomial sums stay exact."""


@torch.no_grad()
def share_opacities(logits: Tensor, log_scales: Tensor, copies: Tensor, *, least: float) -> None:
    """Give Gaussians with copies the opacity and size with which all look as the one did (3DGS-MCMC, equation 9).

    In place; at most MOST_COPIES count.

    logits: [N] of opacities; log_scales: [N, 3]; float32. copies: [N] int32. least: lowest opacity, in (0, 1).
    """
    sums = relocation_sums(logits.device)
    launch(kernels.share_opacities, len(logits), copies, sums, least, logits, log_scales)


@torch.no_grad()
def number_slots(dead: Tensor, added: int) -> tuple[Tensor, Tensor]:
    """Assign numbers to the slots to fill: those of dead Gaussians and then `added` rows behind them.

    Returns [N + added] int32, -1 for living ones, and the number of dead ones, an int64 scalar. dead: [N] bool, N >= 1.
    """
    numbers = dead.cumsum(0)
    slots = torch.empty(len(dead) + added, dtype=torch.int32, device=dead.device)
    launch(kernels.number_slots, len(slots), dead, numbers, slots)
    return slots, numbers[-1]


@torch.no_grad()
def count_copies(samples: "SampledRows", begin: Tensor, end: Tensor, changed: Tensor) -> Tensor:
    """Return [N] int32: for how many of the slots from begin to end each row was sampled.

    begin, end: int64 scalars; none if begin is not below end. Sampled rows are marked in changed [N] bool.
    """
    copies = torch.zeros(len(changed), dtype=torch.int32, device=changed.device)
    count = len(samples.rows)
    launch(kernels.count_copies, count, *samples, begin, end, copies, changed, ranges=single_range(count))
    return copies


@torch.no_grad()
def copy_rows(
    values: Sequence[Tensor],
    sources: Sequence[Tensor],
    slots: Tensor,
    begin: Tensor,
    end: Tensor,
    *,
    samples: "SampledRows | None" = None,
    changed: Tensor | None = None,
) -> None:
    """Fill the rows whose slot is begin + k, below end, with source row k, or with the k-th sampled row, in place.

    values: [N, ...] each; sources: [M, ...] each, contiguous float32. Sources may be the values if no row is both read
    and written. slots: [N] int32, negative for rows that stay. begin, end: int64 scalars. changed: [N] bool, marks
    filled rows.
    """
    for start in range(0, len(values), kernels.AT_ONCE):
        group = slice(start, start + kernels.AT_ONCE)
        arguments = *(samples or (None, None)), *_rows(sources[group]), *_rows(values[group])
        launch(kernels.copy_rows, len(slots), slots, begin, end, *arguments, changed)


@torch.no_grad()
def scale_rows(values: Sequence[Tensor], which: Tensor, factor: float) -> None:
    """Multiply the rows of values, [N, ...] contiguous float32 each, that `which` [N] bool marks, in place.

    A factor of 0 sets them to 0, also what is not finite.
    """
    for start in range(0, len(values), kernels.AT_ONCE):
        launch(kernels.scale_rows, len(which), which, factor, *_rows(values[start : start + kernels.AT_ONCE]))


class SampledRows(NamedTuple):
    """Rows sampled by weights."""

    rows: Tensor  # [K] int64
    total: Tensor  # float64 scalar, of the weights; if it is 0, nothing counts as sampled


def _rows(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Return the tensors as rows, and tensors without columns for those missing to AT_ONCE."""
    none = [tensors[0].new_empty(0, 0)] * (kernels.AT_ONCE - len(tensors))
    return [t.view(len(t), -1) if t.numel() else t.new_empty(0, 0) for t in tensors] + none


@cache
def relocation_sums(device: torch.device) -> Tensor:
    """Return [MOST_COPIES, MOST_COPIES] float64 sums for equation 9 of 3DGS-MCMC.

    Row n - 1 dotted with (o, o^2, ...) is the denominator for n: the sum over i <= n and k < i of binomial(i - 1, k)
    (-1)^k o^(k + 1) / sqrt(k + 1).
    """
    # The binomials of a column sum to one binomial (hockey stick).
    rows = [
        [math.comb(n, k + 1) * (-1) ** k / math.sqrt(k + 1) if k < n else 0.0 for k in range(MOST_COPIES)]
        for n in range(1, MOST_COPIES + 1)
    ]
    with _disable_current_modes():  # The sums outlive the caller's modes.
        return torch.tensor(rows, dtype=torch.float64, device=device)
