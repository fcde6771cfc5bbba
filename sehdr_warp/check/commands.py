"""The command line of `sehdr-warp check`: what may be asked for, and the call. torch is imported when it runs."""

from dataclasses import dataclass
from pathlib import Path

from ..arguments import say
from ..errors import SehdrError


@dataclass(frozen=True)
class Check:
    """Check numerical stability on this device: stiff and extreme cases against float64 truth, each with its bound."""

    cases: str | None = None
    """Cases or groups (splat, light, poison, training) separated by commas; by default all."""
    quick: bool = False
    """Leave out the cases that take seconds."""
    json: Path | None = None
    """Write the result to this file."""
    plots: Path | None = None
    """Instead of the cases: plot error against float64 over scale ratio, radiance range, overlap and exposure into
    this folder."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    overwrite: bool = False
    """Replace files that exist."""


def run_check(command: Check) -> None:
    """Measures, prints the table and writes what was asked for; raises SehdrError if a bound failed, after everything
    was written."""
    from ..files import check_absent
    from ..training.train import pick_device
    from .catalogue import choose_cases, run_cases, write_result

    if command.json is not None:
        check_absent(command.json, command.overwrite)
    device = pick_device(command.device)
    if command.plots is not None:
        from .stability import plot_stability

        for path in plot_stability(command.plots, device, overwrite=command.overwrite, progress=say):
            print(path)
        return
    result = run_cases(choose_cases(command.cases, command.quick), device, print)
    if command.json is not None:
        write_result(result, command.json, command.overwrite)
    if result["failed"]:
        raise SehdrError(
            f"{len(result['failed'])} of {len(result['cases'])} cases exceed their bounds on {device}: "
            f"{', '.join(result['failed'])}; please report them with the device and its driver"
        )
