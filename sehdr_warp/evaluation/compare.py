"""Compare trained runs: figures, means over seeds, and held-out error against time."""

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
from .table import columns, format_figure

COLUMNS = {
    "iterations": ("iterations", 0),
    "gaussians": ("Gaussians", 0),
    "seconds": ("seconds", 1),
    "psnr_ldr": ("LDR, dB", 2),
    "psnr_mu": ("HDR mu-law, dB", 2),
}
"""Heading and digits of each figure of a row. HDR is the mu-law PSNR under the protocol gt-max."""


@dataclass(frozen=True)
class ComparedRuns:
    """Runs that differ by nothing but their seed: a row of a comparison.

    Attributes:
        label: name of the first run's folder.
        scene: name of the scene.
        figures: by column, one value for each run; None if the run has none.
        curves: the lines of each run's metrics.jsonl.
    """

    label: str
    scene: str
    figures: dict[str, list[float | None]]
    curves: list[list[dict[str, Any]]]

    @property
    def count(self) -> int:
        """Return the number of runs."""
        return len(self.curves)

    def mean(self, column: str) -> float | None:
        """Return the mean over the runs; None if one lacks the figure."""
        values = [value for value in self.figures[column] if value is not None]
        return statistics.fmean(values) if len(values) == self.count else None

    def deviation(self, column: str) -> float | None:
        """Return the sample's standard deviation; None for one run, or if one lacks the figure."""
        values = [value for value in self.figures[column] if value is not None]
        return statistics.stdev(values) if len(values) == self.count > 1 else None


def compare_runs(runs: Sequence[Any]) -> list[ComparedRuns]:
    """Return the rows of a comparison, in the order of the runs.

    Runs of one scene whose configs differ by the seed alone share a row.

    Args:
        runs: trained runs, as load_run() returns them.

    Raises:
        SehdrError: without runs, for a run that is named twice, or one without evaluations in its metrics.
    """
    if not runs:
        raise SehdrError("compare: no runs; name their folders")
    groups: dict[str, list] = {}
    paths = [Path(run.path).resolve() for run in runs]
    for run, path in zip(runs, paths, strict=True):
        if paths.count(path) > 1:
            raise SehdrError(f"compare: {run.path} is named twice; leave one out")
        if not run.metrics():
            problem = f"{run.path}: has no evaluations of held-out views"
            raise SehdrError(f"{problem}; train it with some held out (--holdout 8), or further")
        config = run.config.model_dump(mode="json", exclude={"seed"})
        groups.setdefault(json.dumps([run.scene_name, run.data, config], sort_keys=True, default=str), []).append(run)
    return [_row(members) for members in groups.values()]


def _row(runs: Sequence) -> ComparedRuns:
    names = {"iterations": "iterations", "gaussians": "gaussian_count", "seconds": "train_seconds"}
    last = [run.metrics()[-1] | {column: getattr(run, name) for column, name in names.items()} for run in runs]
    figures = {column: [line.get(column) for line in last] for column in COLUMNS}
    label = Path(runs[0].path).name + (f" and {len(runs) - 1} more" if len(runs) > 1 else "")
    if unfinished := sum(run.iterations < run.config.schedule.iterations for run in runs):
        label += " (unfinished)" if len(runs) == 1 else f" ({unfinished} unfinished)"
    return ComparedRuns(label, runs[0].scene_name, figures, [run.metrics() for run in runs])


def comparison_table(rows: Sequence[ComparedRuns]) -> str:
    """Return means with their standard deviation over seeds, for a terminal."""
    return "\n".join(columns(_cells(rows), left=2))


def comparison_latex(rows: Sequence[ComparedRuns]) -> str:
    """Return the same as a LaTeX table (booktabs)."""
    escaped = [[re.sub(r"([&%$#_{}])", r"\\\1", cell) for cell in line] for line in _cells(rows)]
    heading, *lines = [" & ".join(line).replace(" ± ", r" $\pm$ ") + r" \\" for line in escaped]
    begin = rf"\begin{{tabular}}{{ll{'r' * (len(COLUMNS) + 1)}}}"
    return "\n".join([begin, r"\toprule", heading, r"\midrule", *lines, r"\bottomrule", r"\end{tabular}", ""])


def _cells(rows: Sequence[ComparedRuns]) -> list[list[str]]:
    cells = [["run", "scene", "seeds", *(heading for heading, _ in COLUMNS.values())]]
    for row in rows:
        cells.append([row.label, row.scene, str(row.count)])
        for column, (_, digits) in COLUMNS.items():
            deviation = row.deviation(column)
            cells[-1].append(
                format_figure(row.mean(column), digits) + (f" ± {deviation:.{digits}f}" if deviation else "")
            )
    return cells


def comparison_csv(rows: Sequence[ComparedRuns]) -> str:
    """Return means and standard deviations in full precision; a missing one is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", "scene", "seeds", *(name for column in COLUMNS for name in (column, f"{column}_sd"))])
    for row in rows:
        values = [value for column in COLUMNS for value in (row.mean(column), row.deviation(column))]
        writer.writerow([row.label, row.scene, row.count, *values])
    return text.getvalue()
