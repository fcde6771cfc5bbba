"""The one grammar of exposures, used wherever exposures are named, and what a radiance becomes at each of them.

1/125, 0.008, 1/125s    seconds; a number in Python is seconds too
-2ev, +1ev              stops from the photos' exposure
1/8x, 8x                multiples of it
base                    the photos' exposure itself
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

from ..errors import SehdrError

if TYPE_CHECKING:
    import torch

Items = str | Sequence[str | float]

# The paper's figure writes {1/8, 1/4, dt_1, 8, 16}; as multiples of dt_1 it also serves a photo of 1/1000 s.
PAPER_BRACKETS = ("1/8x", "1/4x", "1x", "8x", "16x")
_FORMS = "seconds (1/125), stops (-2ev), multiples (1/8x) or base"


@dataclass(frozen=True)
class Exposure:
    """One exposure. time: seconds. ev: stops above the base exposure, log2(time / base)."""

    time: float
    ev: float

    @property
    def label(self) -> str:
        """`ev-4.0`, with one decimal and always a sign."""
        return f"ev{round(self.ev, 1) + 0.0:+.1f}"  # Adding zero turns -0.0 into 0.0.


def read_exposures(items: Items, base_time: float | None, field: str = "exposures") -> tuple[Exposure, ...]:
    """Exposures, ascending, from items of the grammar above, given as a sequence or separated by commas.

    base_time: the photos' exposure, seconds; None where there are no photos: only seconds can be meant, and `ev` is
    relative to 1 s. field: what the items are called in errors, which are SehdrErrors.
    """
    if base_time is not None and not 0 < base_time < math.inf:
        raise SehdrError(f"base exposure time = {base_time} is not a positive number of seconds; give the photos' one")
    made = sorted(_exposures(items, base_time, field), key=lambda exposure: exposure.time)
    if not made:
        raise SehdrError(f"{field}: the list is empty; give {_FORMS}")
    for first, second in pairwise(made):
        if second.time <= first.time * (1 + 1e-9):
            raise SehdrError(f"{field}: {first.time:.6g} s is given twice; leave one out")
    return tuple(made)


def exposure_times(base_time: float, items: Items = PAPER_BRACKETS) -> tuple[float, ...]:
    """The times of read_exposures, seconds."""
    return tuple(exposure.time for exposure in read_exposures(items, base_time))


def seconds(items: Items, field: str = "exposures") -> tuple[float, ...]:
    """Times of their own, in the order given; SehdrError for an item that is none."""
    return tuple(exposure.time for exposure in _exposures(items, None, field))


def is_seconds(item: str | float) -> bool:
    """Whether an item is a time of its own, not relative to the photos' exposure."""
    text = str(item).strip().lower()
    return not (text == "base" or text.endswith(("ev", "x")))


def _exposures(items: Items, base_time: float | None, field: str) -> list[Exposure]:
    items = [item for item in items.split(",") if item.strip()] if isinstance(items, str) else items
    return [_exposure(item, base_time, field) for item in items]


def _exposure(item: str | float, base_time: float | None, field: str) -> Exposure:
    text = str(item).strip().lower()
    if base_time is None and not is_seconds(text):
        raise SehdrError(f"{field}: {item!r} is relative to photos, and there are none; give seconds, such as 1/125")
    base = 1.0 if base_time is None else base_time
    try:
        if text == "base":
            return Exposure(base, 0.0)
        if text.endswith("ev"):
            ev = float(Fraction(text.removesuffix("ev").strip()))
            made = Exposure(base * 2.0**ev, ev)
        else:
            number = float(Fraction(text.removesuffix("x").removesuffix("s").strip()))
            time = number * base if text.endswith("x") else number
            made = Exposure(time, math.log2(time / base))
    except (ValueError, ZeroDivisionError, OverflowError):
        made = Exposure(math.nan, math.nan)
    if not (math.isfinite(made.time) and made.time > 0):
        raise SehdrError(f"{field}: {item!r} is no exposure above 0; write {_FORMS}")
    return made


def bracket_log_radiance(log_base: "torch.Tensor", times: Sequence[float], base_time: float) -> "torch.Tensor":
    """[n, ...]: log c^{l_j} = log c^{l_1} + log dt_j - log dt_1 (SeHDR, section 3.2), from log_base [...].

    times: n exposure times dt_j, and base_time dt_1, in seconds.
    """
    shifts = tuple(math.log(time) - math.log(base_time) for time in times)
    offsets = _on_device(shifts, log_base.dtype, log_base.device)
    return log_base + offsets.reshape(-1, *[1] * log_base.dim())


@lru_cache(maxsize=64)
def _on_device(values: tuple[float, ...], dtype: "torch.dtype", device: "torch.device") -> "torch.Tensor":
    """Copied once: a copy from the host cannot be part of a recorded training step."""
    import torch

    return torch.tensor(values, dtype=dtype, device=device)
