"""A benchmark's result as a picture."""

from itertools import cycle
from pathlib import Path


def plot_kernels(report: dict, path: Path) -> None:
    """Median times of the splat over the channels, one panel for each pass and size, one line for each
    implementation."""
    rows = [row for row in report["rows"] if row["stage"] == "splat"]
    sizes = list(dict.fromkeys((row["gaussians"], row["width"], row["height"]) for row in rows))
    passes = list(dict.fromkeys(row["pass"] for row in rows))
    names = list(dict.fromkeys(row["implementation"] for row in rows))
    figure, panels = _panels(len(passes), len(sizes))
    for panel_row, passing in zip(panels, passes):
        for axes, size in zip(panel_row, sizes):
            for name in names:
                chosen = [
                    (row["channels"], row["median_ms"])
                    for row in rows
                    if (row["gaussians"], row["width"], row["height"]) == size
                    and row["pass"] == passing
                    and row["implementation"] == name
                ]
                if chosen:
                    axes.plot(*zip(*sorted(chosen)), marker="o", label=name)
            axes.set(title=f"{size[0]:,} at {size[1]} x {size[2]}, {passing}", xlabel="channels", ylabel="median, ms")
            axes.set_yscale("log")
            axes.grid(True, which="both", alpha=0.3)
            axes.legend(fontsize="small")
    figure.savefig(path, dpi=120)


def plot_scale(report: dict, path: Path) -> None:
    """Median times over what is varied, a column for each sweep, and below them peak memory; both axes in decades."""
    rows = [row for row in report["rows"] if row["stage"] == "scale"]
    names = list(dict.fromkeys(row["sweep"] for row in rows))
    labels = list(dict.fromkeys((row["implementation"], row["what"]) for row in rows))
    colors = {what: f"C{place}" for place, what in enumerate(dict.fromkeys(what for _, what in labels))}
    styles = dict(zip(dict.fromkeys(who for who, _ in labels), cycle(("-", "--", ":"))))
    figure, panels = _panels(2, len(names))
    lines = {}
    for panel_row, field, unit, scale in zip(
        panels, ("median_ms", "peak_memory_bytes"), ("median, ms", "peak, MiB"), (1.0, 2.0**-20)
    ):
        for axes, name in zip(panel_row, names):
            for who, what in labels:
                chosen = [
                    (row["varied"], row[field] * scale)
                    for row in rows
                    if (row["sweep"], row["implementation"], row["what"]) == (name, who, what) and row.get(field)
                ]
                if chosen:
                    style = styles[who]
                    lines[f"{who}: {what}"] = axes.plot(*zip(*chosen), style, color=colors[what], marker="o", ms=3)[0]
            axes.set(xlabel=name, ylabel=unit, xscale="log", yscale="log")
            axes.grid(True, which="major", alpha=0.3)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4, fontsize="small")
    figure.savefig(path, dpi=120)


def _panels(rows: int, columns: int):
    """A figure that needs no display, and its axes [rows][columns]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.5 * columns, 3.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


PLOTS = {"kernels": plot_kernels, "scale": plot_scale}
"""Which benchmarks have a picture, and what draws it."""
