"""The whole catalogue, and a run of it: measured case by case, printed as a table."""

import math
import time
from collections.abc import Sequence

import torch

from ..errors import SehdrError
from ..rasterizer.warp_launch.threads import one_torch_thread
from .case import Case
from .light_cases import LIGHT_CASES
from .splat_cases import POISON_CASES, SPLAT_CASES
from .training_cases import TRAINING_CASES

GROUPS = {"splat": SPLAT_CASES, "light": LIGHT_CASES, "poison": POISON_CASES, "training": TRAINING_CASES}
CASES = tuple((group, case) for group, cases in GROUPS.items() for case in cases)


def choose_cases(names: str | None, quick: bool) -> list[tuple[str, Case]]:
    """The cases of these names or groups, separated by commas, each with its group; all by default. quick: those that
    take a moment. Raises SehdrError for a name that is not known."""
    if names is None:
        return [(group, case) for group, case in CASES if case.quick or not quick]
    chosen = {}
    for name in (part.strip() for part in names.split(",")):
        found = {case.name: (group, case) for group, case in CASES if name in (group, case.name)}
        if not found:
            known = ", ".join([*GROUPS, *(case.name for _, case in CASES)])
            raise SehdrError(f"--cases {name:.60}: no such case; take some of {known}")
        chosen |= found
    return list(chosen.values())


def run_cases(cases: Sequence[tuple[str, Case]], device: torch.device) -> list[dict]:
    """Measures the cases, prints a table, and returns a row for each, with its readings.

    torch runs on one thread, so that the figures do not depend on the machine's cores.
    """
    rows, bounds, begun = [], 0, time.perf_counter()
    print(f"{'case':17} {'quantity':47} {'error':>9} {'bound':>9}  verdict")
    with one_torch_thread():
        for group, case in cases:
            started = time.perf_counter()
            readings = list(case.measure(device))
            row = {"case": case.name, "group": group, "what": case.what, "note": case.note or None}
            row |= {"seconds": round(time.perf_counter() - started, 3), "holds": all(r.holds for r in readings)}
            rows.append(row | {"readings": [vars(reading) | {"holds": reading.holds} for reading in readings]})
            bounds += len(readings)
            for place, reading in enumerate(readings):
                numbers = f"{_number(reading.error)} {_number(reading.bound)}  {'ok' if reading.holds else 'FAILED'}"
                print(f"{'' if place else case.name:17} {reading.quantity:47} {numbers}")
    failed = sum(not row["holds"] for row in rows)
    print(f"{len(rows)} cases, {bounds} bounds, {failed} failed, {time.perf_counter() - begun:.1f} s")
    return rows


def _number(value: float) -> str:
    return f"{value:9.0f}" if math.isfinite(value) and value == int(value) and value < 1e6 else f"{value:9.1e}"
