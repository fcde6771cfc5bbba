"""Trained runs side by side: their figures, means over seeds, and held-out error against time."""

import csv
import io
import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import SehdrError

COLUMNS = {
    "iterations": ("iterations", 0),
    "gaussians": ("Gaussians", 0),
    "seconds": ("seconds", 1),
    "psnr_ldr": ("LDR, dB", 2),
    "psnr_mu": ("HDR mu-law, dB", 2),
}
"""Figures of a row: their heading and digits. HDR is the mu-law PSNR under the protocol gt-max."""
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")


@dataclass(frozen=True)
class ComparedRuns:
    """Runs that differ by nothing but their seed.

    Attributes:
        label: of the row.
        scene: that they were trained on.
        figures: {column: one value for each run}; None where a run has none.
        curves: of each run, the lines of its metrics.jsonl.
    """

    label: str
    scene: str
    figures: dict[str, list[float | None]]
    curves: list[list[dict]]

    @property
    def count(self) -> int:
        return len(self.curves)

    def mean(self, column: str) -> float | None:
        """The mean over the runs; None where one lacks it."""
        values = self.figures[column]
        return None if None in values else statistics.fmean(values)

    def spread(self, column: str) -> float | None:
        """The sample's standard deviation; None for one run."""
        values = self.figures[column]
        return None if None in values or len(values) < 2 else statistics.stdev(values)


def compare_runs(runs: Sequence) -> list[ComparedRuns]:
    """Rows of a comparison, in the order of the runs; runs of one scene and config but for the seed share a row.

    Args:
        runs: Runs with at least one evaluation in their metrics.

    Raises:
        SehdrError: without runs, for a run that is given twice, or one that has no figures.
    """
    if not runs:
        raise SehdrError("compare: no runs are given; give their folders")
    groups: dict[str, list] = {}
    for run in runs:
        if sum(Path(other.path).resolve() == Path(run.path).resolve() for other in runs) > 1:
            raise SehdrError(f"compare: {run.path} is given twice; leave one out")
        if not run.metrics():
            raise SehdrError(f"{run.path}: has no evaluations to compare; train it further")
        config = run.config.model_dump(mode="json", exclude={"seed"})
        groups.setdefault(json.dumps([run.scene_name, run.data, config], sort_keys=True, default=str), []).append(run)
    return [_compared(members) for members in groups.values()]


def _compared(runs: Sequence) -> ComparedRuns:
    figures: dict[str, list] = {column: [] for column in COLUMNS}
    for run in runs:
        last = run.metrics()[-1]
        known = {"iterations": run.iterations, "gaussians": run.gaussian_count, "seconds": run.train_seconds}
        for column in COLUMNS:
            figures[column].append(known.get(column, last.get(column)))
    label = Path(runs[0].path).name if len(runs) == 1 else f"{Path(runs[0].path).name} and {len(runs) - 1} more"
    return ComparedRuns(label, runs[0].scene_name, figures, [run.metrics() for run in runs])


def comparison_table(rows: Sequence[ComparedRuns]) -> str:
    """For a terminal: one row for each, means with their standard deviation over seeds."""
    cells = [["run", "scene", "seeds", *(heading for heading, _ in COLUMNS.values())]]
    cells += [[row.label, row.scene, str(row.count), *(_cell(row, column) for column in COLUMNS)] for row in rows]
    widths = [max(len(line[place]) for line in cells) for place in range(len(cells[0]))]
    lines = [
        "  ".join(cell.ljust(width) if place < 2 else cell.rjust(width) for place, (cell, width) in enumerate(pairs))
        for pairs in ([*zip(line, widths, strict=True)] for line in cells)
    ]
    return "\n".join(lines)


def comparison_csv(rows: Sequence[ComparedRuns]) -> str:
    """Means and standard deviations, full precision; empty where there is none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", "scene", "seeds", *(name for column in COLUMNS for name in (column, f"{column}_sd"))])
    for row in rows:
        values = [value for column in COLUMNS for value in (row.mean(column), row.spread(column))]
        writer.writerow([row.label, row.scene, row.count, *values])
    return text.getvalue()


def comparison_latex(rows: Sequence[ComparedRuns]) -> str:
    """A booktabs table."""
    heading = " & ".join(["Run", "Scene", *(heading for heading, _ in COLUMNS.values())])
    lines = [
        " & ".join([_escaped(row.label), _escaped(row.scene), *(_cell(row, column, r" $\pm$ ") for column in COLUMNS)])
        for row in rows
    ]
    end = " \\\\"
    begin = f"\\begin{{tabular}}{{ll{'r' * len(COLUMNS)}}}"
    body = [line + end for line in lines]
    return "\n".join([begin, "\\toprule", heading + end, "\\midrule", *body, "\\bottomrule", "\\end{tabular}", ""])


def comparison_figure(rows: Sequence[ComparedRuns]):
    """A matplotlib Figure: held-out PSNR against training seconds; one color a row, one line a seed."""
    from matplotlib.figure import Figure

    keys = [key for key in ("psnr_ldr", "psnr_mu") if any(_points(c, key) for row in rows for c in row.curves)]
    figure = Figure(figsize=(4.6 * max(len(keys), 1) + 1.6, 3.8), layout="constrained")
    handles = {}
    for place, key in enumerate(keys, 1):
        axes = figure.add_subplot(1, len(keys), place)
        for number, row in enumerate(rows):
            color = _COLORS[number % len(_COLORS)]
            for curve in row.curves:
                if points := _points(curve, key):
                    style = "-" if number < len(_COLORS) else "--"
                    (line,) = axes.plot(*zip(*points, strict=True), style, color=color, marker=".", linewidth=1.6)
                    handles[row.label] = line
        axes.set_title("Photos" if key == "psnr_ldr" else "HDR, mu-law (gt-max)", loc="left", fontsize=10)
        axes.set_xlabel("training time, seconds")
        axes.set_ylabel("held-out PSNR, dB")
        axes.set_xlim(left=0)
        axes.grid(color="#e1e4e8", linewidth=0.8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(handles.values(), handles.keys(), loc="outside right upper", frameon=False, fontsize=8.5)
    return figure


def _points(curve: Sequence[dict], key: str) -> list[tuple[float, float]]:
    return [(line["seconds"], line[key]) for line in curve if line.get(key) is not None and "seconds" in line]


def _cell(row: ComparedRuns, column: str, between: str = " ± ") -> str:
    digits, mean, spread = COLUMNS[column][1], row.mean(column), row.spread(column)
    if mean is None:
        return "-"
    return f"{mean:.{digits}f}" + ("" if not spread else f"{between}{spread:.{digits}f}")


def _escaped(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "&%$#_{}" else letter for letter in text)
