"""Measure cases one by one and print them as a table."""

import math
import time
from collections.abc import Sequence

import torch

from ..rasterizer.warp_launch.threads import one_torch_thread
from .case import Case


def run_cases(cases: Sequence[Case], device: torch.device) -> list[dict]:
    """Measure the cases and print a table.

    torch runs on one thread, so that the figures do not depend on the machine's cores.

    Returns:
        A row for each case: "case", "group", "what", "note", "seconds", "holds" and its "readings".
    """
    rows, bounds, start = [], 0, time.perf_counter()
    print(f"{'case':17} {'quantity':47} {'error':>9} {'bound':>9}  verdict")
    with one_torch_thread():
        for case in cases:
            case_start = time.perf_counter()
            readings = list(case.measure(device))
            row = {"case": case.name, "group": case.group, "what": case.what, "note": case.note or None}
            row |= {"seconds": round(time.perf_counter() - case_start, 3), "holds": all(r.holds for r in readings)}
            rows.append(row | {"readings": [vars(reading) | {"holds": reading.holds} for reading in readings]})
            bounds += len(readings)
            for place, reading in enumerate(readings):
                verdict = "ok" if reading.holds else "FAILED"
                numbers = f"{_format_number(reading.error)} {_format_number(reading.bound)}  {verdict}"
                print(f"{'' if place else case.name:17} {reading.quantity:47} {numbers}")
    failed = sum(not row["holds"] for row in rows)
    print(f"{len(rows)} cases, {bounds} bounds, {failed} failed, {time.perf_counter() - start:.1f} s")
    return rows


def _format_number(value: float) -> str:
    return f"{value:9.0f}" if math.isfinite(value) and value == int(value) and value < 1e6 else f"{value:9.1e}"
