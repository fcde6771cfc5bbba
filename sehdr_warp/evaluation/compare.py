"""Compare trained runs: figures, means over seeds, held-out PSNR; and the tables of `compare` and `eval`."""

import csv
import io
import json
import re
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from ..errors import SehdrError, require_trained

if TYPE_CHECKING:
    from ..runs.run import Run

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
    """Runs that differ by nothing but their seed: a row of a comparison."""

    label: str  # Name of the first run's folder
    scene: str  # Name of the scene
    figures: dict[str, list[float | None]]  # By column, one value for each run; None if the run has none
    curves: list[list[dict[str, Any]]] = field(repr=False)  # The lines of each run's metrics.jsonl

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


def compare_runs(runs: "Sequence[Run]") -> list[ComparedRuns]:
    """Return the rows of a comparison, in the order of the runs.

    Runs of one scene whose configs differ by the seed alone share a row.

    Args:
        runs: trained runs, as load_run() returns them.

    Raises:
        SehdrError: without runs, for a run that is named twice, or one without evaluations in its metrics.
    """
    if not isinstance(runs, str | Iterable):
        raise TypeError(f"runs is {runs!r:.60}, expected a list of runs, as load_run() returns them")
    require_trained(*([runs] if isinstance(runs, str) else runs))
    runs = list(runs)
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
    return [_compare_runs(members) for members in groups.values()]


def _compare_runs(runs: Sequence) -> ComparedRuns:
    names = {"iterations": "iterations", "gaussians": "gaussian_count", "seconds": "train_seconds"}
    last = [run.metrics()[-1] | {column: getattr(run, name) for column, name in names.items()} for run in runs]
    figures = {column: [line.get(column) for line in last] for column in COLUMNS}
    label = Path(runs[0].path).name + (f" and {len(runs) - 1} more" if len(runs) > 1 else "")
    if unfinished := sum(run.iterations < run.config.schedule.iterations for run in runs):
        label += " (unfinished)" if len(runs) == 1 else f" ({unfinished} unfinished)"
    return ComparedRuns(label, runs[0].scene_name, figures, [run.metrics() for run in runs])


def comparison_table(rows: Sequence[ComparedRuns]) -> str:
    """Return means with their standard deviation over seeds, for a terminal."""
    return "\n".join(columns(_cells(rows), texts=2))


def comparison_latex(rows: Sequence[ComparedRuns]) -> str:
    """Return the same as a LaTeX table (booktabs)."""
    escaped = [[re.sub(r"([&%$#_{}])", r"\\\1", cell) for cell in line] for line in _cells(rows)]
    heading, *lines = [" & ".join(line).replace(" ± ", r" $\pm$ ") + r" \\" for line in escaped]
    begin = rf"\begin{{tabular}}{{ll{'r' * (len(COLUMNS) + 1)}}}"
    return "\n".join([begin, r"\toprule", heading, r"\midrule", *lines, r"\bottomrule", r"\end{tabular}", ""])


def _cells(rows: Sequence[ComparedRuns]) -> list[list[str]]:
    cells = [["run", "scene", "runs", *(heading for heading, _ in COLUMNS.values())]]
    for row in rows:
        cells.append([row.label, row.scene, str(row.count)])
        for column, (_, digits) in COLUMNS.items():
            deviation = row.deviation(column)
            spread = f" ± {deviation:.{digits}f}" if deviation else ""
            cells[-1].append(format_figure(row.mean(column), digits) + spread)
    return cells


_FORMULAS = tuple("=+-@\t\r")  # First letters of cells that spreadsheets run


def comparison_csv(rows: Sequence[ComparedRuns]) -> str:
    """Return means and standard deviations in full precision; a missing one is empty.

    A name that a spreadsheet would take for a formula gets an apostrophe before it.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", "scene", "runs", *(name for column in COLUMNS for name in (column, f"{column}_sd"))])
    for row in rows:
        values = [value for column in COLUMNS for value in (row.mean(column), row.deviation(column))]
        names = (f"'{name}" if name.startswith(_FORMULAS) else name for name in (row.label, row.scene))
        writer.writerow([*names, row.count, *values])
    return text.getvalue()


def columns(rows: Sequence[Sequence[str]], texts: int = 1) -> list[str]:
    """Return one line for each row, with aligned cells: the first `texts` flush left, the others flush right."""
    widths = [max(map(len, cells)) for cells in zip_longest(*rows, fillvalue="")]
    sides = [str.ljust] * texts + [str.rjust] * (len(widths) - texts)
    return ["  ".join(side(cell, width) for side, cell, width in zip(sides, row, widths)) for row in rows]


def eval_table(result: dict) -> str:
    """Return the figures of evaluate() as a table for a terminal; missing ones are dashes, with the reasons below."""
    origin = result.get("folder") or (
        f"{result['gaussians']:,} Gaussians, {result['iterations']:,} iterations in {result['train_seconds']:.1f} s"
    )
    rows = [["", "PSNR", "SSIM", "LPIPS"]]
    if "folder" not in result:
        rows.append(_row("LDR", result["ldr"]))
    # Without truth there are no HDR figures, and the reason below says so once.
    names = list(result["protocol"]) if any(figures["views"] for figures in result["protocol"].values()) else []
    rows += [_row(f"HDR mu-law {name}", result["protocol"][name], "_mu") for name in names]
    rows += [_row(f"HDR PU21 {name}", result["pu21"][name]) for name in names]
    ldr = [] if "folder" in result else ["LDR"]
    regions = [["region of the photo", "share", *ldr, *names]]
    for region, figures in result["regions"].items():
        values = [figures["psnr_ldr"]] * len(ldr) + [figures["psnr_mu"][name] for name in names]
        regions.append([region, f"{figures['fraction']:.1%}", *(format_figure(value, 2) for value in values)])
    count, split = len(result["views"]), {"train": "training"}.get(result["split"], result["split"])
    lines = [f"{result['scene']}: {count} {split} view{'s' * (count != 1)}, {origin}", "", *columns(rows)]
    lines += ["", *columns(regions)]
    ranking = result["confidence"]
    if ranking["spearman_log2"] is not None:
        correlations = f"{ranking['spearman_log2']:.2f} (log2), {ranking['spearman_mu']:.2f} (mu-law)"
        lines += ["", f"confidence ranks errors: {correlations}; mean confidence {ranking['mean']:.2f}"]
    if result["lights"]["count"]:
        counts = "lights: {count} in the truth, {lost} lost".format(**result["lights"])
        lines += ["", counts + _energies(result["lights"])]
    return "\n".join([*lines, "", *_notes(result, bool(names))])


def _energies(lights: dict) -> str:
    """Return the energy of clipped lights in words; nothing if none clips."""
    ratios = lights.get("energies")
    if not ratios:
        return ""
    figures = f"{ratios[0]:.2f} to {ratios[-1]:.2f} times their energy, median {median(ratios):.2f}"
    return f"; those that clip ({len(ratios)}) have {figures}"


def _row(label: str, figures: dict, suffix: str = "") -> list[str]:
    digits = {f"psnr{suffix}": 2, f"ssim{suffix}": 4, f"lpips{suffix}": 4}
    return [label, *(format_figure(figures[key], count) for key, count in digits.items() if key in figures)]


def format_figure(value: float | None, digits: int) -> str:
    """Return a figure with this number of digits after the point, or a dash for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def _notes(result: dict, has_truth: bool) -> list[str]:
    peak = result["pu21"]["peak_luminance"]
    notes = [f"PU21: the maximum of each view's truth is shown at {peak:g} cd/m^2."] * has_truth
    if (scale := result["protocol"]["aligned"].get("scale")) is not None:
        where = "the scored views" if result.get("scale_from") == "scored" else "the training photos"
        notes.append(f"aligned: radiance times {scale:.4g}, fitted on pixels that {where} do not clip.")
    if result["lights"]["lost"] and result["lights"].get("energies"):
        notes.append("lights: light that clips in every photo is estimated; darker photos would measure it.")
    if result["lpips_backbone"]:
        notes.append(f"LPIPS: {result['lpips_backbone']}.")
    if result["split"] == "train":
        notes.append("There are no test views: these figures are of the training views.")
    figures = [*([] if "folder" in result else [result["ldr"]]), *result["protocol"].values()]
    reasons = [entry[key] for entry in figures for key in ("reason", "lpips_reason") if key in entry]
    return notes + [f"-: {reason}." for reason in dict.fromkeys(reasons)]
