"""The command line of `sehdr-warp bench response`."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from ..arguments import positive, say


@dataclass(frozen=True, kw_only=True)
class Responses:
    """How well the camera's response is found from photos alone: on scenes with HDR truth and on exposure stacks."""

    data: tyro.conf.Positional[tuple[str, ...]] = ("embedded",)
    """Scenes with HDR truth, and folders of exposure stacks (photos and exposures.json)."""
    curves: str | None = None
    """Responses that expose the scenes, separated by commas; by default HDR-NeRF's, four encodings, two film curves."""
    exposures: int = 5
    """Exposures of each scene, each four times longer than the last."""
    single: bool = False
    """Judge a scene by one photo instead of by all training photos."""
    max_size: int | None = None
    """Longest side of the scenes' photos, in pixels."""
    seed: int = 0
    """Seed of the sample of edges."""
    json: Path | None = None
    """Write the result, with every trial, to this file."""
    out: Path | None = None
    """Folder for the result as JSON and table."""
    overwrite: bool = False
    """Replace files that exist."""


def run_responses(asked: Responses) -> None:
    """Measures, prints the table and writes what was asked for."""
    from .report import check_writable, format_report, write_report
    from .response import CURVES, bench_response

    curves = CURVES if asked.curves is None else tuple(filter(None, map(str.strip, asked.curves.split(","))))
    check_writable("response", asked.json, asked.out, asked.overwrite)
    report = bench_response(
        asked.data,
        curves,
        exposures=positive("--exposures", asked.exposures),
        single=asked.single,
        max_size=asked.max_size,
        seed=asked.seed,
        progress=say,
    )
    print(format_report(report))
    write_report(report, json=asked.json, out=asked.out, overwrite=asked.overwrite)
