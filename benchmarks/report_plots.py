"""The plots of the reports: matplotlib figures that need no display, saved small."""

import io
import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.ticker import NullLocator

from sehdr_warp.output.report.charts import COLORS, RULE

from .report_tables import median_of_runs
from .results import groups


def plot_kernels(result: dict, path: Path) -> None:
    """Median times over channels: a panel for each size, a line for each implementation, forward and backward."""
    rows, panels = [row for row in median_of_runs(result["rows"]) if row["pass"] != "forward"], []
    for (count, width, height), here in groups(rows, "gaussians", "width", "height").items():
        lines = {
            name: sorted((row["channels"], row["median_ms"]) for row in mine)
            for (name,), mine in groups(here, "implementation").items()
        }
        most = max(row["median_ms"] for row in here)
        labels = {"xlabel": "channels", "ylabel": "forward + backward, ms", "ylim": (0, 1.1 * most)}
        panels.append((lines, labels | {"title": f"{count:,} Gaussians, {width} x {height}"}))
    _draw(path, [panels])


def plot_quality(result: dict, path: Path) -> None:
    """Plot the mean held-out PSNR over training seconds: a panel for each curve and response, a line for each method.

    Scenes, exposures and seeds that all methods of a panel have count, if there are any; else all.
    """
    rows, panels = [row for row in result["rows"] if row["tests"]], []
    for curve, response in groups([row for row in rows if row["response"] != "learned"], "curve", "response"):
        plotted = [row for row in rows if row["curve"] == curve and row["response"] in (response, "learned")]
        places = groups(plotted, "scene", "exposure", "seed").values()
        methods = {row["method"] for row in plotted}
        shared = [row for here in places if {row["method"] for row in here} == methods for row in here]
        row_groups = groups(shared or plotted, "method").items()
        lines = {method: error_over_time([row["tests"] for row in mine]) for (method,), mine in row_groups}
        labels = {"xlabel": "training seconds", "ylabel": "held-out HDR PSNR, dB", "xscale": "log"}
        panels.append((lines, labels | {"title": f"{curve}, {response}"}))
    _draw(path, [panels], form="-")


def decade_ticks(least: float, most: float) -> list[float]:
    """1, 2 and 5 times the powers of ten within two bounds."""
    powers = range(math.floor(math.log10(least)), math.ceil(math.log10(most)) + 1)
    return [tick for power in powers for part in (1, 2, 5) if least <= (tick := part * 10.0**power) <= most]


def error_over_time(trainings: Sequence[Sequence], count: int = 60) -> list[tuple[float, float]]:
    """(seconds, mean dB) of trainings, each a list of [seconds, dB], at times even on a log scale.

    Between two tests a PSNR is interpolated over the logarithm of time; the mean starts when all have one; a training
    that has ended keeps its last figure.
    """
    curves = [np.array(tests, float).T for tests in trainings]
    first, last = max(curve[0, 0] for curve in curves), max(curve[0, -1] for curve in curves)
    seconds = np.geomspace(max(first, 1e-3), max(last, first, 1e-3), count)
    values = [np.interp(np.log(seconds), np.log(np.maximum(time, 1e-3)), psnr) for time, psnr in curves]
    return list(zip(seconds, np.mean(values, axis=0), strict=True))


def _draw(path: Path, panels: Sequence[Sequence[tuple[dict, dict]]], form: str = "o-") -> None:
    """Write a PNG of 32 colors, which is all that lines need, with one legend below.

    panels: rows of ({label: points}, what Axes.set() takes).
    """
    from matplotlib.figure import Figure
    from PIL import Image

    width = max((len(row) for row in panels), default=1)
    figure = Figure(figsize=(max(4.2 * width, 6.4), 3.2 * len(panels) + 0.5), layout="constrained")
    handles = {}
    for place, (lines, labels) in enumerate(panel for row in panels for panel in row):
        axes = figure.add_subplot(len(panels), width, place + 1)
        for (name, points), color in zip(lines.items(), cycle(COLORS)):
            if points:
                (handles[name],) = axes.plot(*zip(*points, strict=True), form, color=color, markersize=3, label=name)
        axes.set(**labels)
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            if axis.get_scale() == "log":
                axis.set_minor_locator(NullLocator())
                axis.set_ticks(ticks := decade_ticks(*limits), [f"{tick:g}" for tick in ticks])
        axes.grid(color=RULE, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90, format="png")
    Image.open(buffer).convert("RGB").quantize(32).save(path, format="PNG", optimize=True)
