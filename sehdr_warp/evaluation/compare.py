"""Trained runs side by side: their figures, means over seeds, and held-out error against time."""

import csv
import io
import json
import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import SehdrError
from .table import columns, number

COLUMNS = {
    "iterations": ("iterations", 0),
    "gaussians": ("Gaussians", 0),
    "seconds": ("seconds", 1),
    "psnr_ldr": ("LDR, dB", 2),
    "psnr_mu": ("HDR mu-law, dB", 2),
}
"""Figures of a row: their heading and digits. HDR is the mu-law PSNR under the protocol gt-max."""


@dataclass(frozen=True)
class ComparedRuns:
    """Runs that differ by nothing but their seed: a row of a comparison.

    figures: {column: one value for each run}; None where a run has none. curves: each run's lines of metrics.jsonl.
    """

    label: str
    scene: str
    figures: dict[str, list[float | None]]
    curves: list[list[dict[str, Any]]]

    @property
    def count(self) -> int:
        return len(self.curves)

    def mean(self, column: str) -> float | None:
        """The mean over the runs; None where one lacks it."""
        values = [value for value in self.figures[column] if value is not None]
        return statistics.fmean(values) if len(values) == self.count else None

    def spread(self, column: str) -> float | None:
        """The sample's standard deviation; None for one run, or where one lacks the figure."""
        values = [value for value in self.figures[column] if value is not None]
        return statistics.stdev(values) if len(values) == self.count > 1 else None


def compare_runs(runs: Sequence[Any]) -> list[ComparedRuns]:
    """Rows of a comparison, in the order of the runs; runs of one scene and config but for the seed share a row.

    Args:
        runs: of load_run.

    Raises:
        SehdrError: without runs, for a run that is given twice, or one without evaluations in its metrics.
    """
    if not runs:
        raise SehdrError("compare: no runs are given; give their folders")
    groups: dict[str, list] = {}
    places = [Path(run.path).resolve() for run in runs]
    for run, place in zip(runs, places, strict=True):
        if places.count(place) > 1:
            raise SehdrError(f"compare: {run.path} is given twice; leave one out")
        if not run.metrics():
            problem = f"{run.path}: has no evaluations of held-out views"
            raise SehdrError(f"{problem}; train it with some held out (--holdout 8), or further")
        config = run.config.model_dump(mode="json", exclude={"seed"})
        groups.setdefault(json.dumps([run.scene_name, run.data, config], sort_keys=True, default=str), []).append(run)
    return [_compared(members) for members in groups.values()]


def _compared(runs: Sequence) -> ComparedRuns:
    names = {"iterations": "iterations", "gaussians": "gaussian_count", "seconds": "train_seconds"}
    last = [run.metrics()[-1] | {column: getattr(run, name) for column, name in names.items()} for run in runs]
    figures = {column: [line.get(column) for line in last] for column in COLUMNS}
    label = Path(runs[0].path).name + (f" and {len(runs) - 1} more" if len(runs) > 1 else "")
    if stopped := sum(run.iterations < run.config.schedule.iterations for run in runs):
        label += " (not ended)" if len(runs) == 1 else f" ({stopped} not ended)"
    return ComparedRuns(label, runs[0].scene_name, figures, [run.metrics() for run in runs])


def comparison_table(rows: Sequence[ComparedRuns]) -> str:
    """For a terminal: means with their standard deviation over seeds."""
    return "\n".join(columns(_cells(rows), left=2))


def comparison_latex(rows: Sequence[ComparedRuns]) -> str:
    """The same as a booktabs table."""
    escaped = [[re.sub(r"([&%$#_{}])", r"\\\1", cell) for cell in line] for line in _cells(rows)]
    heading, *lines = [" & ".join(line).replace(" ± ", r" $\pm$ ") + r" \\" for line in escaped]
    begin = rf"\begin{{tabular}}{{ll{'r' * (len(COLUMNS) + 1)}}}"
    return "\n".join([begin, r"\toprule", heading, r"\midrule", *lines, r"\bottomrule", r"\end{tabular}", ""])


def _cells(rows: Sequence[ComparedRuns]) -> list[list[str]]:
    cells = [["run", "scene", "seeds", *(heading for heading, _ in COLUMNS.values())]]
    for row in rows:
        cells.append([row.label, row.scene, str(row.count)])
        for column, (_, digits) in COLUMNS.items():
            spread = row.spread(column)
            cells[-1].append(number(row.mean(column), digits) + (f" ± {spread:.{digits}f}" if spread else ""))
    return cells


def comparison_csv(rows: Sequence[ComparedRuns]) -> str:
    """Means and standard deviations, full precision; empty where there is none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", "scene", "seeds", *(name for column in COLUMNS for name in (column, f"{column}_sd"))])
    for row in rows:
        values = [value for column in COLUMNS for value in (row.mean(column), row.spread(column))]
        writer.writerow([row.label, row.scene, row.count, *values])
    return text.getvalue()
