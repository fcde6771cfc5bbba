"""Held-out error over training seconds, a line for each method, with the Pareto front."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..output.report import STYLE
from .quality_rows import by_table, line_name

# Hues that the colour-blind tell apart (Okabe and Ito); later methods repeat them dashed.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#1f2328")
FRONT = "#b7bcc2"


def error_over_time(rows: Sequence[dict], count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """(seconds, mean held-out PSNR in dB) of the trainings of one method, `count` times evenly on a log scale.

    Between two tests the PSNR is interpolated over the logarithm of time; before its first test a training has none, so
    the mean starts when all have one; a training that has ended keeps its last figure.
    """
    tests = [[line for line in row["curve"] if line.get("psnr_mu") is not None] for row in rows]
    curves = [np.array([(line["seconds"], line["psnr_mu"]) for line in lines], float).T for lines in tests if lines]
    if not curves:
        return np.empty(0), np.empty(0)
    first, last = max(curve[0, 0] for curve in curves), max(curve[0, -1] for curve in curves)
    seconds = np.geomspace(max(first, 1e-3), max(last, first, 1e-3), count)
    values = [np.interp(np.log(seconds), np.log(np.maximum(time, 1e-3)), psnr) for time, psnr in curves]
    return seconds, np.mean(values, axis=0)


def pareto_front(lines: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """The best PSNR that any line has reached by each time: (seconds, dB), increasing both."""
    points = [point for line in lines for point in zip(*map(np.ndarray.tolist, line), strict=True)]
    points.sort(key=lambda point: (point[0], -point[1]))
    front, best = [], -np.inf
    for time, value in points:
        if value > best:
            front.append((time, value))
            best = value
    return tuple(np.array(front, float).reshape(-1, 2).T)


def plot_error_over_time(rows: Sequence[dict], path: Path) -> None:
    """Writes a PNG: a panel for each curve and knowledge of the response, HDR error under gt-max over seconds.

    rows: of one kind of device.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    panels: dict[tuple, dict[str, list[dict]]] = {}
    for (_, curve, response), members in by_table(rows).items():
        panel = panels.setdefault((curve, response), {})
        for row in members:
            panel.setdefault(line_name(row, rows), []).append(row)
    names = list(dict.fromkeys(name for panel in panels.values() for name in panel))
    styles = {
        name: (COLOURS[k % len(COLOURS)], ("-", "--", ":")[k // len(COLOURS) % 3]) for k, name in enumerate(names)
    }
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4 * len(panels) + 1.4, 4.6), layout="constrained")
        axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for place, (panel, (title, methods)) in enumerate(zip(axes, panels.items(), strict=True)):
            _panel(panel, methods, styles)
            jobs = sum(map(len, methods.values()))
            panel.set_title(f"{title[0]}, response {title[1]} ({jobs} trainings)", loc="left", fontweight="bold")
            panel.set_ylabel("held-out HDR, mu-law PSNR (gt-max), dB" if place == 0 else "")
        device = rows[0]["machine"]["gpu"]
        where = device["name"] if device else f"{rows[0]['machine']['cpu']}, {rows[0]['machine']['threads']} threads"
        figure.supxlabel(f"training seconds ({where})", fontsize=9)
        figure.savefig(path, dpi=160, facecolor="white", format="png")


def _panel(axes, methods: dict[str, list[dict]], styles: dict) -> None:
    lines = {name: error_over_time(items) for name, items in methods.items()}
    lines = {name: line for name, line in lines.items() if len(line[0])}
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.grid(axis="y", color="#e1e4e8", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if not lines:
        axes.text(0.5, 0.5, "no held-out figures", transform=axes.transAxes, ha="center")
        return
    # Methods that were given the HDR truth do not compete with those that had photos alone.
    fair = [line for name, line in lines.items() if not methods[name][0]["config"]["method"]["truth"]]
    if fair:
        axes.step(*pareto_front(fair), where="post", color=FRONT, linewidth=6, label="Pareto front, from photos alone")
        axes.legend(loc="lower right", frameon=False, fontsize=8.5)
    for name, (seconds, psnr) in lines.items():
        colour, dashes = styles[name]
        axes.plot(seconds, psnr, dashes, color=colour, linewidth=1.8)
        axes.plot(seconds[-1], psnr[-1], "o", color=colour, markersize=4)
    _label_ends(axes, lines, styles)


def _label_ends(axes, lines: dict, styles: dict) -> None:
    """Names and last values in a column at the right, in the lines' order, none over another."""
    low, high = axes.get_ylim()
    step = (high - low) / 17
    ends = sorted((psnr[-1], name) for name, (_, psnr) in lines.items())
    places: list[float] = []
    for value, _ in ends:
        places.append(max(value, places[-1] + step) if places else max(value, low))
    overshoot = max(0.0, places[-1] - high)
    for (value, name), place in zip(ends, places, strict=True):
        text = f"{name}  {value:.1f}"
        where = (1.02, place - overshoot)
        axes.annotate(text, where, xycoords=("axes fraction", "data"), color=styles[name][0], va="center", fontsize=8.5)
