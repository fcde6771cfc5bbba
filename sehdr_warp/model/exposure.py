"""The grammar of exposures, used wherever exposures are named, and the radiance of a bracket.

1/125, 0.008, 1/125s    seconds; a number in Python is seconds too
-2ev, +1ev              stops from the photos' exposure
1/8x, 8x                multiples of it
base                    the photos' exposure itself
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from numbers import Real
from typing import TYPE_CHECKING

from ..errors import SehdrError

if TYPE_CHECKING:
    import torch

Exposures = str | Sequence[str | float]  # As written: text with commas between, or a sequence

# The paper's figure writes {1/8, 1/4, dt_1, 8, 16}; as multiples of dt_1 it also serves a photo of 1/1000 s.
PAPER_BRACKETS = ("1/8x", "1/4x", "1x", "8x", "16x")
_FORMS = "seconds (1/125), stops (-2ev), multiples (1/8x) or base"


@dataclass(frozen=True)
class Exposure:
    """One exposure."""

    time: float  # Seconds
    ev: float  # Stops above the base exposure, log2(time / base)

    @property
    def label(self) -> str:
        """Name with a sign and one decimal, such as `ev-4.0`."""
        return f"ev{round(self.ev, 1) + 0.0:+.1f}"  # Adding zero turns -0.0 into 0.0.


def read_exposures(items: Exposures, base_time: float | None, field: str = "exposures") -> tuple[Exposure, ...]:
    """Parse exposures of the grammar above and sort them by time.

    Args:
        items: A sequence, or text separated by commas.
        base_time: The photos' exposure, seconds; None if there are no photos: then only seconds are allowed, and `ev`
            is relative to 1 s.
        field: What the items are called in errors.

    Raises:
        SehdrError: If an item is not an exposure, or two are equal.
    """
    if base_time is not None and not (isinstance(base_time, Real) and 0 < base_time < math.inf):
        raise SehdrError(
            f"base exposure time = {base_time!r:.60} is not a positive number of seconds; give the photos' one"
        )
    parsed = sorted(_exposures(items, base_time, field), key=lambda exposure: exposure.time)
    if not parsed:
        raise SehdrError(f"{field}: the list is empty; give {_FORMS}")
    for first, second in pairwise(parsed):
        if second.time <= first.time * (1 + 1e-9):
            raise SehdrError(f"{field}: {first.time:.6g} s appears twice; leave one out")
    return tuple(parsed)


def exposure_times(base_time: float, items: Exposures = PAPER_BRACKETS) -> tuple[float, ...]:
    """Return the times of read_exposures(), seconds."""
    return tuple(exposure.time for exposure in read_exposures(items, base_time))


def seconds(items: Exposures, field: str = "exposures") -> tuple[float, ...]:
    """Return times in the order of the items; raises SehdrError for an item that is not in seconds."""
    return tuple(exposure.time for exposure in _exposures(items, None, field))


def is_seconds(item: str | float) -> bool:
    """Return whether an item is a time by itself, not relative to the photos' exposure."""
    text = str(item).strip().lower()
    return not (text == "base" or text.endswith(("ev", "x")))


def _exposures(items: Exposures, base_time: float | None, field: str) -> list[Exposure]:
    """Parse each item of a list or of text separated by commas; raise TypeError for what is neither."""
    if not isinstance(items, str | Iterable):
        raise TypeError(f"{field} is {items!r:.60}, expected a list, or text with commas")
    items = [item for item in items.split(",") if item.strip()] if isinstance(items, str) else items
    return [_exposure(item, base_time, field) for item in items]


def _exposure(item: str | float, base_time: float | None, field: str) -> Exposure:
    """Parse one item."""
    text = str(item).strip().lower()
    if base_time is None and not is_seconds(text):
        raise SehdrError(f"{field}: {item!r} is relative to photos, and there are none; give seconds, such as 1/125")
    base = 1.0 if base_time is None else base_time
    try:
        if text == "base":
            return Exposure(base, 0.0)
        if text.endswith("ev"):
            ev = float(Fraction(text.removesuffix("ev").strip()))
            parsed = Exposure(base * 2.0**ev, ev)
        else:
            number = float(Fraction(text.removesuffix("x").removesuffix("s").strip()))
            time = number * base if text.endswith("x") else number
            parsed = Exposure(time, math.log2(time / base))
    except (ValueError, ZeroDivisionError, OverflowError):
        parsed = Exposure(math.nan, math.nan)
    if not (math.isfinite(parsed.time) and parsed.time > 0):
        raise SehdrError(f"{field}: {item!r} is not an exposure above 0; write {_FORMS}")
    return parsed


def bracket_log_radiance(log_base: "torch.Tensor", times: Sequence[float], base_time: float) -> "torch.Tensor":
    """Return [n, ...] log c^{l_j} = log c^{l_1} + log dt_j - log dt_1 (SeHDR, equation 8) for times dt_j, seconds."""
    shifts = tuple(math.log(time) - math.log(base_time) for time in times)
    offsets = _on_device(shifts, log_base.dtype, log_base.device)
    return log_base + offsets.reshape(-1, *[1] * log_base.dim())


@lru_cache(maxsize=64)
def _on_device(values: tuple[float, ...], dtype: "torch.dtype", device: "torch.device") -> "torch.Tensor":
    """Return a cached tensor: a copy from the host cannot be part of a CUDA graph."""
    import torch

    return torch.tensor(values, dtype=dtype, device=device)
