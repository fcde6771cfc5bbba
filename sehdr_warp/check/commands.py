"""The command line of `sehdr-warp check`. torch is imported when it runs."""

from dataclasses import dataclass

from ..bench.commands import Output
from ..errors import SehdrError


@dataclass(frozen=True, kw_only=True)
class Check(Output):
    """Check numerical stability on this device: stiff and extreme cases against float64, each with its bound."""

    cases: str | None = None
    """Cases or groups (splat, light, poison, training) separated by commas; by default all."""
    quick: bool = False
    """Leave out the cases that take seconds."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""


def run_check(command: Check) -> None:
    """Raises SehdrError if a bound failed, after everything was written."""
    from ..bench.results import new_result
    from ..files import check_absent, write_json
    from ..runs.device import pick_device
    from .catalogue import choose_cases, run_cases

    if command.json is not None:
        check_absent(command.json, command.overwrite)
    device, cases = pick_device(command.device), choose_cases(command.cases, command.quick)
    result = new_result("stability", device, {"device": str(device)}) | {"rows": run_cases(cases, device)}
    if command.json is not None:
        write_json(command.json, result, command.overwrite)
    if failed := [row["case"] for row in result["rows"] if not row["holds"]]:
        count = f"{len(failed)} of {len(cases)} cases exceed their bounds on {device}"
        raise SehdrError(f"{count}: {', '.join(failed)}; please report them with the device and its driver")
