"""The command line of `sehdr-warp check`. torch is imported when it runs."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from ..errors import SehdrError

if TYPE_CHECKING:
    import torch

    from .case import Case


@dataclass(frozen=True, kw_only=True)
class Check:
    """Check that this machine renders correctly: stiff and extreme scenes against float64, in seconds."""

    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.
    json: Path | None = None  # Also write the figures, with a description of this machine, to this file.
    overwrite: bool = False  # Replace the file of --json.

    removed_flags: ClassVar[dict[str, str]] = {
        "--quick": "every check is quick now",
        "--cases": "in a checkout, python -m benchmarks stability --cases chooses among more cases",
    }


def run_check(options: Check) -> None:
    """Measure every case; raise SehdrError, after everything is written, if one exceeds its bound."""
    from ..files import check_absent, write_json
    from ..runs.device import pick_device
    from .result import new_result
    from .splat_cases import POISON_CASES, SPLAT_CASES

    if options.json is not None:
        check_absent(options.json, options.overwrite)
    device = pick_device(options.device)
    cases = [case for case in (*SPLAT_CASES, *POISON_CASES) if case.quick]
    result = new_result("check", device, {"device": str(device)}) | {"rows": run_cases(cases, device)}
    if options.json is not None:
        write_json(options.json, result, options.overwrite)
    require_bounds(result["rows"], device)


def run_cases(cases: "Sequence[Case]", device: "torch.device") -> list[dict]:
    """Measure the cases and print a table.

    torch runs on one thread, so that the figures do not depend on the machine's cores.

    Returns:
        A row for each case: "case", "group", "what", "note", "seconds", "holds" and its "readings".
    """
    from ..rasterizer.warp_launch.threads import one_torch_thread

    rows, start = [], time.perf_counter()
    print(f"{'case':17} {'quantity':47} {'error':>9} {'bound':>9}  verdict")
    with one_torch_thread():
        for case in cases:
            case_start = time.perf_counter()
            readings = list(case.measure(device))
            row = {"case": case.name, "group": case.group, "what": case.what, "note": case.note or None}
            row |= {"seconds": round(time.perf_counter() - case_start, 3), "holds": all(r.holds for r in readings)}
            rows.append(row | {"readings": [vars(reading) | {"holds": reading.holds} for reading in readings]})
            for place, reading in enumerate(readings):
                numbers = f"{_format_number(reading.error)} {_format_number(reading.bound)}"
                verdict = "ok" if reading.holds else "FAILED"
                print(f"{'' if place else case.name:17} {reading.quantity:47} {numbers}  {verdict}")
    bounds, failed = sum(len(row["readings"]) for row in rows), sum(not row["holds"] for row in rows)
    print(f"{len(rows)} cases, {bounds} bounds, {failed} failed, {time.perf_counter() - start:.1f} s")
    return rows


def _format_number(value: float) -> str:
    return f"{value:9.0f}" if math.isfinite(value) and value == int(value) and value < 1e6 else f"{value:9.1e}"


def require_bounds(rows: list[dict], device: object) -> None:
    """Raise SehdrError, which names the cases, if a row of run_cases() exceeds its bounds."""
    if failed := [row["case"] for row in rows if not row["holds"]]:
        count = f"{len(failed)} of {len(rows)} cases exceed their bounds on {device}"
        raise SehdrError(f"{count}: {', '.join(failed)}; please report them with the device and its driver")
