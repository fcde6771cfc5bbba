"""The command line of `sehdr-warp check`. torch is imported when it runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from ..errors import SehdrError


@dataclass(frozen=True, kw_only=True)
class Check:
    """Check that this machine renders correctly: stiff and extreme scenes against float64, in seconds."""

    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    json: Path | None = None
    """Also write the figures, with a description of this machine, to this file."""
    overwrite: bool = False
    """Replace the file of --json."""

    removed_flags: ClassVar[dict[str, str]] = {
        "--quick": "every check is quick now",
        "--cases": "in a checkout, python -m benchmarks stability --cases chooses among more cases",
    }


def run_check(options: Check) -> None:
    """Measure every case; raise SehdrError, after everything is written, if one exceeds its bound."""
    from ..files import check_absent, write_json
    from ..runs.device import pick_device
    from .result import new_result
    from .run_cases import run_cases
    from .splat_cases import POISON_CASES, SPLAT_CASES

    if options.json is not None:
        check_absent(options.json, options.overwrite)
    device = pick_device(options.device)
    cases = [case for case in (*SPLAT_CASES, *POISON_CASES) if case.quick]
    result = new_result("check", device, {"device": str(device)}) | {"rows": run_cases(cases, device)}
    if options.json is not None:
        write_json(options.json, result, options.overwrite)
    require_bounds(result["rows"], device)


def require_bounds(rows: list[dict], device: object) -> None:
    """Raise SehdrError, which names the cases, if a row of run_cases() exceeds its bounds."""
    if failed := [row["case"] for row in rows if not row["holds"]]:
        count = f"{len(failed)} of {len(rows)} cases exceed their bounds on {device}"
        raise SehdrError(f"{count}: {', '.join(failed)}; please report them with the device and its driver")
