"""The plots of `bench report`: matplotlib figures that need no display, saved small."""

import io
from collections.abc import Iterable, Sequence
from itertools import cycle
from pathlib import Path

import numpy as np

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#1f2328")
"""Hues that the color-blind tell apart (Okabe and Ito)."""
SMALLEST = 2.0**-28
"""An exact result has no place on a logarithmic axis: it is drawn here."""


def plot_kernels(result: dict, path: Path) -> None:
    """Median times over channels: a panel for each size, a line for each implementation, forward and backward."""
    rows = [row for row in result["rows"] if row["pass"] != "forward"]
    sizes = _unique((row["gaussians"], row["width"], row["height"]) for row in rows)
    figure, (panels,) = _panels(1, len(sizes))
    for axes, size in zip(panels, sizes, strict=True):
        here = [row for row in rows if (row["gaussians"], row["width"], row["height"]) == size]
        for name, color in zip(_unique(row["implementation"] for row in here), cycle(COLORS)):
            points = sorted((row["channels"], row["median_ms"]) for row in here if row["implementation"] == name)
            axes.plot(*zip(*points, strict=True), "o-", color=color, markersize=3, label=name)
        title = f"{size[0]:,} Gaussians, {size[1]} x {size[2]}"
        axes.set(title=title, xlabel="channels", ylabel="forward + backward, ms", yscale="log")
    _save(figure, path, legend_of=panels)


def plot_scale(result: dict, path: Path) -> None:
    """Median times and, below, peak memory over what is varied; both axes in decades."""
    rows = result["rows"]
    names = _unique(row["sweep"] for row in rows)
    lines = _unique((row["implementation"], row["what"]) for row in rows)
    figure, panels = _panels(2, len(names))
    for panel_row, field, unit in zip(panels, ("median_ms", "peak_memory_bytes"), ("median, ms", "peak, bytes")):
        for axes, name in zip(panel_row, names, strict=True):
            for line, color in zip(lines, cycle(COLORS)):
                here = [row for row in rows if (row["sweep"], row["implementation"], row["what"]) == (name, *line)]
                if points := [(row["varied"], row[field]) for row in here if row.get(field)]:
                    axes.plot(*zip(*points, strict=True), "o-", color=color, markersize=3, label=": ".join(line))
            axes.set(xlabel=name, ylabel=unit, xscale="log", yscale="log")
    _save(figure, path, legend_of=panels[0])


def plot_quality(result: dict, path: Path) -> None:
    """Mean held-out PSNR over training seconds, a panel for each curve and response, a line for each method."""
    rows = [row for row in result["rows"] if row["tests"]]
    tables = _unique((row["curve"], row["response"]) for row in rows if row["response"] != "learned")
    figure, (panels,) = _panels(1, len(tables))
    for axes, (curve, response) in zip(panels, tables, strict=True):
        members = [row for row in rows if row["curve"] == curve and row["response"] in (response, "learned")]
        for name, color in zip(_unique(row["method"] for row in rows), cycle(COLORS)):
            if here := [row["tests"] for row in members if row["method"] == name]:
                axes.plot(*error_over_time(here), color=color, label=name)
        axes.set(title=f"{curve}, {response}", xlabel="training seconds", ylabel="held-out HDR PSNR, dB", xscale="log")
    _save(figure, path, legend_of=panels)


def error_over_time(trainings: Sequence[Sequence], count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """(seconds, mean dB) of trainings, each a list of [seconds, dB], at times even on a log scale.

    Between two tests a PSNR is interpolated over the logarithm of time; the mean starts when all have one; a training
    that has ended keeps its last figure.
    """
    curves = [np.array(tests, float).T for tests in trainings]
    first, last = max(curve[0, 0] for curve in curves), max(curve[0, -1] for curve in curves)
    seconds = np.geomspace(max(first, 1e-3), max(last, first, 1e-3), count)
    values = [np.interp(np.log(seconds), np.log(np.maximum(time, 1e-3)), psnr) for time, psnr in curves]
    return seconds, np.mean(values, axis=0)


def plot_stability(result: dict, path: Path) -> None:
    """Errors as solid lines over each sweep, their bounds as dotted ones of the same color."""
    figure, panels = _panels(2, 2)
    for axes, sweep in zip(panels.flat, result["sweeps"], strict=False):
        for (name, readings), color in zip(sweep["readings"].items(), cycle(COLORS)):
            errors, bounds = zip(*readings, strict=True)
            drawn = [max(error or 0.0, SMALLEST) for error in errors]
            axes.plot(sweep["values"], drawn, "o-", color=color, markersize=3, label=name)
            axes.plot(sweep["values"], bounds, ":", color=color, linewidth=1)
        scale = "log" if sweep["values"][-1] > 1000 else "linear"
        axes.set(xlabel=sweep["label"], ylabel="relative error", xscale=scale, yscale="log")
        axes.legend(frameon=False, fontsize=7)
    _save(figure, path)


def _unique(items: Iterable) -> list:
    return list(dict.fromkeys(items))


def _panels(rows: int, columns: int):
    """A figure, and its axes [rows][columns]."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(4.2 * columns, 6.4), 3.2 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat:
        axes.grid(color="#e1e4e8", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _save(figure, path: Path, legend_of: Sequence = ()) -> None:
    """As a PNG of 32 colors, which is all that lines need. legend_of: axes whose lines one legend below names."""
    from PIL import Image

    named = {}
    for axes in legend_of:
        named |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if named:
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90, format="png")
    Image.open(buffer).convert("RGB").quantize(32).save(path, format="PNG", optimize=True)
