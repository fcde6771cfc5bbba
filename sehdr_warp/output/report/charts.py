"""Charts of trainings: held-out PSNR against time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from warnings import catch_warnings, filterwarnings

# Hues that the colour-blind tell apart (Okabe and Ito).
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
INK, QUIET, RULE = "#1f2328", "#6a737d", "#e1e4e8"
PANELS = {"psnr_ldr": "Photos", "psnr_mu": "HDR, mu-law (gt-max)"}
"""Figures of a line of metrics.jsonl, and what their panels are called."""
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["Inter", "Helvetica Neue", "Arial", "DejaVu Sans"],
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": QUIET,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "axes.edgecolor": RULE,
    "text.parse_math": False,  # A dollar sign in a name is one.
}


def save_picture(figure: Any, path: Path, dpi: int) -> None:
    """Write a matplotlib Figure as PNG, without warnings about letters that no installed font has."""
    with catch_warnings():
        filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(path, dpi=dpi, facecolor="white", format="png")


def training_points(curve: Sequence[Mapping], key: str) -> list[tuple[float, float]]:
    """Return (seconds, dB) of the lines of metrics.jsonl that have both."""
    return [(line["seconds"], line[key]) for line in curve if line.get(key) is not None and "seconds" in line]


def training_chart(rows: Mapping[str, Sequence[Sequence[Mapping]]]):
    """Plot held-out PSNR against training seconds, one panel for each of PANELS that has figures.

    Args:
        rows: Label -> the metrics of one run, or of several that differ by their seed. Each label has a color and each
            run a line; for a single label the panel's title states the last figure.

    Returns:
        A matplotlib Figure.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    keys = [key for key in PANELS if any(training_points(c, key) for curves in rows.values() for c in curves)]
    with rc_context(STYLE):
        layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12)
        figure = Figure(figsize=(4.6 * max(len(keys), 1) + 1.6 * (len(rows) > 1), 3.8), layout=layout)
        handles = {}
        for place, key in enumerate(keys, 1):
            axes = figure.add_subplot(1, len(keys), place)
            title = PANELS[key]
            for number, (label, curves) in enumerate(rows.items()):
                color, line = COLORS[number % len(COLORS)], "-" if number < len(COLORS) else "--"
                for points in filter(None, (training_points(curve, key) for curve in curves)):
                    (handles[label],) = axes.plot(*zip(*points), marker=".", linewidth=1.6, color=color, linestyle=line)
                    title = f"{PANELS[key]}: {points[-1][1]:.1f} dB" if len(rows) == len(curves) == 1 else title
            axes.set_title(title, loc="left", fontsize=10, fontweight="bold")
            axes.set_xlabel("training time, seconds")
            axes.set_ylabel("held-out PSNR, dB")
            axes.set_xlim(left=0)
            axes.grid(axis="y", color=RULE, linewidth=0.8)
            axes.tick_params(length=0)
            axes.spines[["top", "right", "left"]].set_visible(False)
        if len(rows) > 1:
            labels = [f" {label}" if label.startswith("_") else label for label in handles]  # Else they are left out.
            figure.legend(handles.values(), labels, loc="outside right upper", frameon=False, fontsize=8.5)
        return figure
