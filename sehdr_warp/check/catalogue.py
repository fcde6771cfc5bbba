"""The whole catalogue, and a run of it: measured case by case, told as a table, written as JSON."""

import math
import time
from pathlib import Path

import torch

from ..errors import SehdrError
from ..files import write_json
from .case import Case, Reading
from .light_cases import CASES as LIGHT_CASES
from .poison_cases import CASES as POISON_CASES
from .splat_cases import CASES as SPLAT_CASES
from .training_cases import CASES as TRAINING_CASES

CASES: tuple[Case, ...] = (*SPLAT_CASES, *LIGHT_CASES, *POISON_CASES, *TRAINING_CASES)


def choose_cases(names: str | None, quick: bool) -> list[Case]:
    """The cases of these names or groups, separated by commas; all by default. quick: those that take a moment.

    Raises SehdrError for a name that is not known.
    """
    if names is None:
        return [case for case in CASES if case.quick or not quick]
    chosen = []
    for name in (part.strip() for part in names.split(",")):
        found = [case for case in CASES if name in (case.name, case.group)]
        if not found:
            known = ", ".join(dict.fromkeys([case.group for case in CASES] + [case.name for case in CASES]))
            raise SehdrError(f"--cases {name:.60}: no such case; take some of {known}")
        chosen += [case for case in found if case not in chosen]
    return chosen


def run_cases(cases: list[Case], device: torch.device, say) -> dict:
    """Measures the cases and returns what write_result takes; say(line) is called with the table's lines.

    torch runs on one thread, so that the figures do not depend on the machine's cores.
    """
    started, rows = time.perf_counter(), []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    say(f"{'case':17} {'quantity':42} {'error':>9} {'bound':>9}  verdict")
    try:
        for case in cases:
            case_started = time.perf_counter()
            readings = case.measure(device)
            rows.append(_row(case, readings, time.perf_counter() - case_started))
            for line in _lines(case, readings):
                say(line)
    finally:
        torch.set_num_threads(threads)
    failed = [row["case"] for row in rows if not row["holds"]]
    seconds = time.perf_counter() - started
    say(f"{len(rows)} cases, {sum(len(row['readings']) for row in rows)} bounds, {len(failed)} failed, {seconds:.1f} s")
    return {"format": 1, "device": str(device), "seconds": round(seconds, 1), "failed": failed, "cases": rows}


def write_result(result: dict, path: Path, overwrite: bool) -> None:
    """Writes the result as JSON; errors that are not finite become null. Raises as write_json does."""
    write_json(path, result, overwrite)


def _row(case: Case, readings: list[Reading], seconds: float) -> dict:
    return {
        "case": case.name,
        "group": case.group,
        "what": case.what,
        "note": case.note,
        "seconds": round(seconds, 3),
        "holds": all(reading.holds for reading in readings),
        "readings": [{"quantity": r.quantity, "error": r.error, "bound": r.bound, "holds": r.holds} for r in readings],
    }


def _lines(case: Case, readings: list[Reading]) -> list[str]:
    lines = []
    for place, reading in enumerate(readings):
        name = case.name if place == 0 else ""
        verdict = "ok" if reading.holds else "FAILED"
        lines.append(f"{name:17} {reading.quantity:42.42} {_number(reading.error)} {_number(reading.bound)}  {verdict}")
    return lines


def _number(value: float) -> str:
    return f"{value:9.0f}" if math.isfinite(value) and value == int(value) and value < 1e6 else f"{value:9.1e}"
