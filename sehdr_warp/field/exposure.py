"""Exposure brackets: which times, and what a radiance becomes at each of them."""

import math
from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise

import torch

from ..errors import SehdrError

# The interior figure of the paper writes {1/8, 1/4, dt_1, 8, 16}; read as multiples of dt_1, so that it also serves a
# photo of 1/1000 s.
PAPER_BRACKETS = ("1/8", "1/4", "1", "8", "16")


def exposure_times(base_time: float, spec: str | Sequence[str | float] = PAPER_BRACKETS) -> tuple[float, ...]:
    """The exposure times in seconds of a bracket, ascending, from a description.

    base_time: dt_1 of the photos, seconds, positive.
    spec: items, or one string of them separated by commas. A number or fraction is a multiple of base_time (`1/8`,
        `16`); with `ev` it is in stops from it (`-2ev`); with `s` it is a time (`1/125s`); `base` is base_time itself.

    Raises SehdrError, with the item, for one that is not a number, not positive or not finite, and for a time that
    occurs twice (its weight would count double).
    """
    base_time = _positive(base_time, "base_time")
    items = spec.split(",") if isinstance(spec, str) else list(spec)
    times = sorted(_bracket_time(base_time, item) for item in items)
    if not times:
        raise SehdrError("exposures: the list is empty; give at least one, such as 'base'")
    for first, second in pairwise(times):
        if second <= first * (1 + 1e-9):
            raise SehdrError(f"exposures: {first:.6g} s occurs twice in {spec!r}; leave one out")
    return tuple(times)


def _bracket_time(base_time: float, item: str | float) -> float:
    text = str(item).strip().lower()
    if text == "base":
        return base_time
    in_stops, in_seconds = text.endswith("ev"), text.endswith("s")
    try:
        number = float(Fraction(text.removesuffix("ev").removesuffix("s").strip()))
        time = 2.0**number * base_time if in_stops else number if in_seconds else number * base_time
    except (ValueError, ZeroDivisionError, OverflowError):
        time = math.nan
    if not (math.isfinite(time) and time > 0):
        raise SehdrError(
            f"exposures: {item!r} is no time above 0; write a multiple (1/8), stops (-3ev), seconds (1/125s) or base"
        )
    return time


def _positive(time: float, field: str) -> float:
    time = float(time)
    if not (math.isfinite(time) and time > 0):
        raise SehdrError(f"{field} = {time} is not a positive number of seconds; give the photos' exposure time")
    return time


def bracket_log_radiance(log_base: torch.Tensor, times: Sequence[float], base_time: float) -> torch.Tensor:
    """log c^{l_j} = log c^{l_1} + log dt_j - log dt_1 (SeHDR, section 3.2, natural logarithm).

    log_base: [...] log of the linear radiance at the input exposure, c^{l_1} = E dt_1; any shape, such as [N, 3].
    times: n exposure times dt_j, and base_time dt_1, in seconds.
    Returns [n, ...]: exp of it is the linear radiance at each exposure. SehdrError for a time that is not positive.
    """
    shifts = [math.log(_positive(time, "times")) - math.log(_positive(base_time, "base_time")) for time in times]
    offsets = _on_device(tuple(shifts), log_base.dtype, log_base.device)
    return log_base + offsets.reshape(-1, *[1] * log_base.dim())


@lru_cache(maxsize=64)
def _on_device(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Copied once: a copy from the host cannot be part of a recorded training step."""
    return torch.tensor(values, dtype=dtype, device=device)
